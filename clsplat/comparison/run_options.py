"""Complete options of the runs of a comparison on a scene, checked before the first of these runs."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InputError
from ..scenes.scene import Scene
from ..training.config import TrainConfig
from ..training.decisions import decide
from ..training.initialise import check_init
from ..training.no_effect import no_effect
from ..training.rate_limits import check_rates
from .methods import Method


def decided_config(label: str, config: TrainConfig, scene: Scene) -> TrainConfig:
    """Return the complete options of a run (`decide`), checked as far as that needs no device.

    Parameters
    ----------
    label : of the method, for messages.

    Raises
    ------
    InputError : names the method: a rate with which every run diverges, or a start that cannot be read.
    """
    try:
        check_init(config.start.init)
        config = decide(scene, config).config
        check_rates(config)
    except InputError as error:
        raise InputError(f"system {label}: {error.message}", *error.remedies) from None
    return config


def unused_changes(
    methods: Sequence[Method], labels: Sequence[str], configs: Sequence[TrainConfig], scene: Scene
) -> list[str]:
    """Return a message for each change of a method that has no effect in any of its runs on a scene.

    Parameters
    ----------
    labels : labels of the methods of the runs. configs : complete options of the runs.
    """
    messages = []
    for method in methods:
        runs = [config for label, config in zip(labels, configs, strict=True) if label == method.label]
        for key in method.changes:
            reasons = list(dict.fromkeys(no_effect(config, key, scene) for config in runs))
            if None not in reasons and runs:
                messages.append(f"system {method.label}: {key} has no effect {' or '.join(map(str, reasons))}")
    return messages
