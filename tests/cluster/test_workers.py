"""Which workers a machine starts: their devices, cores and schedules."""

from __future__ import annotations

from dataclasses import replace

import pytest

from clsplat.cluster import workers as module
from clsplat.cluster.job import DEVICE_VARIABLE, RESOURCE
from clsplat.cluster.workers import WorkerPlan, plan_workers
from clsplat.device.device import DeviceInfo, open_device
from clsplat.errors import ClusterError, DeviceError, InputError
from clsplat.rendering.tuning import SCHEDULE_VARIABLE, schedule_for


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> dict[str, DeviceInfo]:
    """A machine with a CPU of eight cores and two GPUs, by index."""
    cpu = replace(open_device().info, index="0:0", type="CPU")
    infos = {"0:0": cpu, "1:0": replace(cpu, index="1:0", type="GPU"), "1:1": replace(cpu, index="1:1", type="GPU")}

    class Opened:
        def __init__(self, index: str | None) -> None:
            if index is not None and index not in infos:
                raise DeviceError(f"no device {index}")
            self.info = infos[index or "1:0"]

    monkeypatch.setattr(module, "list_devices", lambda: list(infos.values()))
    monkeypatch.setattr(module, "open_device", Opened)
    monkeypatch.setattr(module, "schedule_for", lambda device: f"schedule of {device.info.index}")
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    return infos


def devices_and_cores(plans: list[WorkerPlan]) -> list[tuple[str, tuple[int, ...] | None]]:
    return [(plan.device, plan.cores) for plan in plans]


def test_one_worker_on_each_named_device(machine: dict[str, DeviceInfo]) -> None:
    assert devices_and_cores(plan_workers(["1:1", "0:0"])) == [("1:1", None), ("0:0", None)]
    assert devices_and_cores(plan_workers([None])) == [("1:0", None)], "the best device"
    assert devices_and_cores(plan_workers(["1:1", "1:1"])) == [("1:1", None)]


def test_workers_on_a_cpu_share_its_cores(machine: dict[str, DeviceInfo]) -> None:
    plans = plan_workers(["0:0"], 3)
    assert devices_and_cores(plans) == [("0:0", (0, 1)), ("0:0", (2, 3, 4)), ("0:0", (5, 6, 7))]
    assert len({plan.name for plan in plans}) == 3
    mixed = plan_workers(["0:0", "1:0"], 4)
    assert devices_and_cores(mixed) == [("0:0", (0, 1, 2, 3)), ("1:0", None), ("0:0", (4, 5, 6, 7)), ("1:0", None)]
    with pytest.raises(InputError, match="9 workers on 8 cores"):
        plan_workers(["0:0"], 9)


def test_local_workers_take_all_gpus_or_pairs_of_cores(machine: dict[str, DeviceInfo]) -> None:
    local = plan_workers([None], local=True)
    assert [(plan.device, plan.schedule) for plan in local] == [
        ("1:0", "schedule of 1:0"),
        ("1:1", "schedule of 1:1"),
    ]
    del machine["1:0"], machine["1:1"]
    machine["1:0"] = machine["0:0"]  # what `open_device` returns for None
    assert [plan.cores for plan in plan_workers(["0:0"], local=True)] == [(0, 1), (2, 3), (4, 5), (6, 7)]


def test_an_unknown_device_is_refused(machine: dict[str, DeviceInfo]) -> None:
    with pytest.raises(DeviceError, match="no device 7:7"):
        plan_workers(["7:7"])


def test_local_workers_have_the_schedule_of_a_run_without_them() -> None:
    (plan,) = plan_workers([open_device().info.index], 1, local=True)
    assert plan.schedule == str(schedule_for(open_device()))


def test_options_of_the_process() -> None:
    options = WorkerPlan("w", "0:1", (2, 3), "1x16x16").options()
    assert options["resources"] == {RESOURCE: 1}
    assert options["env"] == {DEVICE_VARIABLE: "0:1", SCHEDULE_VARIABLE: "1x16x16"}
    assert "{2, 3}" in options["preload"][-1]
    assert len(WorkerPlan("w", "0:1").options()["preload"]) == 1


def test_a_process_that_never_starts_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(module, "MOST_STARTS", 2)
    monkeypatch.setattr(module, "_IGNORE_CTRL_C", "import os; os._exit(3)")
    plans = [WorkerPlan("w", open_device().info.index)]
    dies = pytest.raises(ClusterError, match=r"^worker w: its process dies again and again while it starts")
    with dies, module.local_cluster(plans):
        pass
