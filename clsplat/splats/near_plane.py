"""The near plane of a model: splats whose centres have a smaller depth are not drawn.

Close to a camera the projection of a splat is far too large, and a single splat can hide all others. The plane belongs
to the model, because training sees no splat that is nearer.
"""

from __future__ import annotations

from .model_number import ModelNumber

NEAR_PLANE = 0.01  # of models that name none [world units]
NEAR_PLANES = ModelNumber("near_plane", NEAR_PLANE, "a depth above 0")
