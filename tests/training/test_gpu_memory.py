"""The table of memory on GPUs: more memory fits more, and the page has the table."""

from __future__ import annotations

from dataclasses import replace

import gpu_memory
import pytest

from clsplat.training.memory_estimate import fault

CASES = list(gpu_memory.cases())


@pytest.mark.parametrize("case", CASES, ids=str)
def test_more_memory_fits_more(case: gpu_memory.Case) -> None:
    ranks = [
        next(rank for rank, word in enumerate(("at most", "bands", "fits")) if word in case.verdict(info))
        for info in map(gpu_memory.device_of, gpu_memory.GIGABYTES)
    ]
    assert ranks == sorted(ranks)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_largest_buffer_is_under_a_quarter_of_memory(case: gpu_memory.Case) -> None:
    for info in map(gpu_memory.device_of, gpu_memory.GIGABYTES):
        assert case.needed(info).largest_buffer < info.max_alloc_bytes
        assert fault(case.needed(info), replace(info, global_mem_bytes=1 << 40)) is None


def test_the_page_has_the_table() -> None:
    assert gpu_memory.table() in gpu_memory.PAGE.read_text(encoding="utf-8"), "run gpu_memory.py --write"
