"""Composite of splats and meshes: two scenes, and nodes that put the nearer image over the farther."""

from __future__ import annotations

from typing import Any

import bpy

from .engine import IDNAME, MESHES, meshes_of
from .errors import reported

_SUFFIX = " splats"
_LAYERS = "CompositorNodeRLayers"
_USUAL = (_LAYERS, "CompositorNodeComposite")  # nodes of a new tree of Blender before 5
_NEW = bpy.app.version >= (5, 0, 0)  # the compositor is a node group and shares nodes with shaders


def composite(scene: Any, engine: str) -> Any:
    """Render `scene`'s meshes with `engine`, its splats with clsplat, and combine both pixel by pixel.

    The splats are rendered in a second scene with the same objects and camera. Each pixel shows the nearer of the two
    images over the farther one, by depth and alpha. If a pixel has splats before and behind a surface, their mean depth
    decides. Both films become transparent, so that edges are smooth. The world still lights the meshes but is not
    visible. Another call makes the second scene anew, with objects that were added. It keeps the nodes.

    Returns
    -------
    The second scene.

    Raises
    ------
    InputError : `scene` is such a second scene, or Blender before 5 would lose its nodes.
    """
    from clsplat.errors import InputError

    if (meshes := meshes_of(scene)) is not None:
        raise InputError(f"this is the scene of the splats: go to the scene {meshes.name} first")
    before = next((other for other in bpy.data.scenes if meshes_of(other) == scene), None)
    known = [] if before is None else [node for node in _layers_in_trees() if node.scene == before]
    if not (_NEW or known) and any(node.bl_idname not in _USUAL for node in _nodes(scene)):
        raise InputError("the scene has compositing nodes, which would be lost: make a group of them elsewhere first")
    for layer in scene.view_layers:
        layer.use_pass_z = True
    splats = scene.copy()
    splats[MESHES] = scene
    splats.render.engine = IDNAME
    splats.render.film_transparent = scene.render.film_transparent = True
    _use_nodes(splats, None)
    for layer in splats.view_layers:
        layer.use_pass_z = True
    scene.render.engine = engine
    if known:
        for node in known:
            node.scene = splats
    else:
        _combine(scene, splats)
    if before is not None:
        bpy.data.scenes.remove(before)
    splats.name = scene.name + _SUFFIX
    return splats


def _layers_in_trees() -> list[Any]:
    """Return the nodes of all compositing trees that show a scene."""
    if _NEW:
        nodes = [node for tree in bpy.data.node_groups for node in tree.nodes]
    else:
        nodes = [node for scene in bpy.data.scenes for node in _nodes(scene)]
    return [node for node in nodes if node.bl_idname == _LAYERS]


def _nodes(scene: Any) -> list[Any]:
    """Return the compositing nodes of a scene of Blender before 5."""
    return list(scene.node_tree.nodes) if scene.node_tree else []


def _combine(scene: Any, splats: Any) -> None:
    """Make the nodes that combine the images of both scenes."""
    tree, sink = _tree(scene)
    of_splats, of_meshes = _layers(tree, splats, 0), _layers(tree, scene, -300)
    nearer = tree.nodes.new(_named("ShaderNodeMath", "CompositorNodeMath"))
    nearer.operation, nearer.location = "LESS_THAN", (300, -300)
    tree.links.new(of_splats.outputs["Depth"], nearer.inputs[0])
    tree.links.new(of_meshes.outputs["Depth"], nearer.inputs[1])
    before, behind = _over(tree, of_meshes, of_splats, 100), _over(tree, of_splats, of_meshes, -100)
    mix = tree.nodes.new(_named("ShaderNodeMix", "CompositorNodeMixRGB"))
    mix.location = (700, 0)
    if mix.bl_idname == "ShaderNodeMix":
        mix.data_type = "RGBA"
        factor = mix.inputs["Factor"]
        first, second = (socket for socket in mix.inputs if socket.name in ("A", "B") and socket.type == "RGBA")
        result = next(socket for socket in mix.outputs if socket.type == "RGBA")
    else:
        factor, first, second, result = mix.inputs[0], mix.inputs[1], mix.inputs[2], mix.outputs[0]
    for source, target in (
        (nearer.outputs[0], factor),
        (behind.outputs[0], first),
        (before.outputs[0], second),
        (result, sink),
    ):
        tree.links.new(source, target)


def _use_nodes(scene: Any, tree: Any) -> None:
    """Set or remove the compositing tree of the scene."""
    if _NEW:
        scene.compositing_node_group = tree
    else:
        scene.use_nodes = tree is not None


def _tree(scene: Any) -> tuple[Any, Any]:
    """Return an empty compositing tree of the scene, and the socket of its output image.

    The user's own tree stays in the file.
    """
    if _NEW:
        if scene.compositing_node_group is not None:
            scene.compositing_node_group.use_fake_user = True
        tree = bpy.data.node_groups.new(f"{scene.name} clsplat", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        scene.compositing_node_group = tree
        node = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        node = tree.nodes.new("CompositorNodeComposite")
    node.location = (900, 0)
    return tree, node.inputs["Image"]


def _layers(tree: Any, scene: Any, height: int) -> Any:
    node = tree.nodes.new(_LAYERS)
    node.scene, node.location = scene, (0, height)
    return node


def _over(tree: Any, background: Any, foreground: Any, height: int) -> Any:
    """Return a node that puts one image over another."""
    node = tree.nodes.new("CompositorNodeAlphaOver")
    node.location = (300, height)
    images = [socket for socket in node.inputs if socket.type == "RGBA"]
    tree.links.new(background.outputs["Image"], images[0])
    tree.links.new(foreground.outputs["Image"], images[1])
    return node


def _named(*kinds: str) -> str:
    """Return the kind of node that this version of Blender has."""
    return kinds[0] if _NEW else kinds[1]


class Composite(bpy.types.Operator):  # type: ignore[misc]
    """Render meshes with an engine of Blender, and put splats before and behind them by depth"""

    bl_idname = "clsplat.composite"
    bl_label = "Composite With Meshes"
    bl_options = {"REGISTER", "UNDO"}

    engine: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Engine",
        items=[
            ("CYCLES", "Cycles", "Path tracing"),
            ("BLENDER_EEVEE", "EEVEE", "Needs a graphics card"),
            ("BLENDER_WORKBENCH", "Workbench", "Needs a graphics card"),
        ],
    )

    @reported
    def execute(self, context: Any) -> set[str]:
        splats = composite(context.scene, self.engine)
        self.report({"INFO"}, f"the scene {splats.name} renders the splats; the compositor combines both")
        return {"FINISHED"}


CLASSES = (Composite,)
