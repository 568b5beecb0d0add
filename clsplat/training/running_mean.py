"""Running means of loss and PSNR for the display. Two views differ more than one view at two times."""

from __future__ import annotations

from collections.abc import Iterable

from .loss import PendingValue

WINDOW = 100  # views of a running mean, if a scene has as many


class RunningLoss:
    """Exponential means of the loss and the PSNR over the last training views.

    Each later value multiplies the weight of a value by 1 - 2 / (N + 1). The values are then on average as old as in
    the mean of the last N. The weights are divided by their sum, which corrects the first means (Kingma and
    Ba 2015, Adam, section 3).

    Parameters
    ----------
    views : number of training views; N is this number, at most WINDOW.
    """

    def __init__(self, views: int) -> None:
        self._decay = 1 - 2 / (min(views, WINDOW) + 1)
        self._weight = self._loss = self._psnr = 0.0
        self._pending: list[PendingValue] = []

    def observe(self, values: Iterable[PendingValue]) -> None:
        """Take the losses of an iteration, without waiting for the device."""
        self._pending.extend(values)

    def means(self) -> tuple[float, float]:
        """Return the means of the loss and of the PSNR [dB], after waiting for the device; NaN without a value."""
        for pending in self._pending:
            value = pending.wait()
            self.add(value.total, value.psnr)
        self._pending = []
        if not self._weight:
            return float("nan"), float("nan")
        return self._loss / self._weight, self._psnr / self._weight

    def add(self, loss: float, psnr: float) -> None:
        """Take the values of one view."""
        share = 1 - self._decay
        self._weight = self._decay * self._weight + share
        self._loss = self._decay * self._loss + share * loss
        self._psnr = self._decay * self._psnr + share * psnr
