"""Removal of what the rules name, as far as the training views allow.

Rules follow one another, those first whose candidates cost the least PSNR: a rule whose candidates are worth much would
else leave nothing of the tolerance for a veil that is worth little. All candidates of a rule go if the training PSNR
stays within the tolerance; else those that change the images least go, up to a threshold that bisection finds. At most
40 evenly chosen training views judge each step. All training views check the result: if they lose more, the last rules
are taken back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import activity
from ..compression.importance import measure_importance
from ..compression.prune import highest_threshold
from ..errors import InputError
from ..evaluation.evaluate import Evaluation, evaluate
from ..evaluation.floaters import evenly, mean_psnr
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.color import BLACK, Color
from ..splats.fields import DoubleArray
from ..splats.splats import Splats
from .rules import DESCRIPTIONS, FREE, Mask, candidates_of_views, candidates_without_views

JUDGES = 40  # largest number of views that judge the steps of a bisection
JUDGED_SHARE = 0.5  # of the tolerance, if some views are no judges: the mean of all may lose more than the judges'


@dataclass(frozen=True)
class RuleResult:
    """What one rule removed.

    Attributes
    ----------
    rule : name of the rule, see DESCRIPTIONS.
    candidates : splats that the rule named, without those of earlier rules. removed : those that were removed.
    cost : loss of PSNR on the views that judged it [dB]; None without views.
    """

    rule: str
    candidates: int
    removed: int
    cost: float | None = None


@dataclass(frozen=True)
class Cleaned:
    """The result of cleaning.

    Attributes
    ----------
    splats : the splats that are left, with their bits and in their order.
    rules : what each rule removed, in the order in which they were applied.
    before, after : metrics of all training views; None without views.
    """

    splats: Splats
    rules: tuple[RuleResult, ...]
    before: Evaluation | None = None
    after: Evaluation | None = None


def clean_without_views(splats: Splats) -> Cleaned:
    """Remove the candidates of the rules that need no photos: faint, oversized and isolated splats.

    Raises
    ------
    InputError : no splat would be left.
    """
    results, kept = [], np.ones(len(splats), np.bool_)
    for rule, mask in candidates_without_views(splats).items():
        removed = int(np.sum(kept & mask))
        results.append(RuleResult(rule, removed, removed))
        kept &= ~mask
    _check_left(int(kept.sum()))
    return Cleaned(splats.select(kept), tuple(results))


def clean(
    splats: Splats,
    views: Sequence[View],
    extent: float,
    renderer: Renderer,
    background: Color = BLACK,
    tolerance: float = 0.05,
    min_views: int = 3,
) -> Cleaned:
    """Remove the candidates of all rules, as far as the training views allow.

    Parameters
    ----------
    views : the training views. extent : size of the scene [world units].
    tolerance : allowed loss of PSNR over the training views [dB].
    min_views : splats that fewer views see are candidates.

    Raises
    ------
    InputError : the model has no splats, none would be left, or an option has a bad value.
    """
    if not len(splats):
        raise InputError("clean: the model has no splats")
    if not tolerance >= 0:
        raise InputError(f"tolerance {tolerance}: must be at least 0 dB")
    if min_views < 1:
        raise InputError(f"min_views {min_views}: must be at least 1")
    before = _measure(renderer, splats, views, background)
    activity.report("measuring what each training view needs")
    masks = candidates_without_views(splats, extent) | candidates_of_views(splats, views, renderer, min_views)
    change = measure_importance(renderer, splats, views, background, parts=False).removal
    judges = evenly(views, JUDGES)

    def psnr(candidate: Splats) -> float:
        return mean_psnr(renderer, candidate, judges, background) if len(candidate) else 0.0

    now = psnr(splats)
    floor = now - tolerance * (1.0 if len(judges) == len(views) else JUDGED_SHARE)
    kept, results = np.ones(len(splats), np.bool_), []
    states: list[Mask] = []
    activity.report("measuring what the candidates of each rule are worth")
    for rule in _cheapest_first(splats, masks, now, psnr):
        states.append(kept)
        activity.report(f"rule {rule}: {int(np.sum(kept & masks[rule]))} candidates")
        after, value = _apply(splats, kept, masks[rule], change, now, floor, psnr)
        results.append(RuleResult(rule, int(np.sum(kept & masks[rule])), int(kept.sum() - after.sum()), now - value))
        kept, now = after, value
    _check_left(int(kept.sum()))
    left = splats.select(kept)
    end = _measure(renderer, left, views, background)
    while end.psnr < before.psnr - tolerance and states:
        kept, number = states.pop(), len(states)
        if results[number].removed:
            results[number] = replace(results[number], removed=0, cost=0.0)
            left = splats.select(kept)
            end = _measure(renderer, left, views, background)
    return Cleaned(left, tuple(results), before, end)


def _cheapest_first(splats: Splats, masks: dict[str, Mask], now: float, psnr: Callable[[Splats], float]) -> list[str]:
    """Return the rules by the PSNR that all their candidates are worth; those of what no view shows come first."""
    named = [rule for rule in DESCRIPTIONS if rule in masks]
    worth = {rule: now - psnr(splats.select(~masks[rule])) for rule in named if rule not in FREE and masks[rule].any()}
    return sorted(named, key=lambda rule: (rule not in FREE, worth.get(rule, 0.0)))


def _apply(
    splats: Splats,
    kept: Mask,
    mask: Mask,
    change: DoubleArray,
    now: float,
    floor: float,
    psnr: Callable[[Splats], float],
) -> tuple[Mask, float]:
    """Remove the candidates that change the images least, as many as the floor of the PSNR allows.

    Parameters
    ----------
    kept : (N,) splats that are left. mask : (N,) candidates. change : (N,) change of the images without each splat.
    now : PSNR of the splats that are left [dB].

    Returns
    -------
    The splats that are left, (N,), and their PSNR.
    """
    if not (kept & mask).any():
        return kept, now
    present = np.flatnonzero(kept)
    scores = np.where(mask[present], change[present], np.inf)
    left = splats.select(kept)
    threshold, found, value = highest_threshold(
        scores, left, now, floor, lambda present, limit: present.select(scores > limit), psnr
    )
    if len(found) == len(left):
        return kept, now
    after = kept.copy()
    after[present[scores <= threshold]] = False
    return after, value


def _measure(renderer: Renderer, splats: Splats, views: Sequence[View], background: Color) -> Evaluation:
    activity.report(f"measuring {len(views)} training views")
    return evaluate(renderer, splats, views, background)


def _check_left(count: int) -> None:
    if not count:
        raise InputError("clean: no splat would be left: look at the model with another program")
