"""`clsplat worker`: do the runs that a scheduler hands out."""

from __future__ import annotations

import click

from .command import DocumentedCommand
from .options import quiet_option


@click.command(
    "worker",
    cls=DocumentedCommand,
    examples=(
        ("clsplat worker tcp://HOST:8786", "A worker on the best device of this machine."),
        ("clsplat worker tcp://HOST:8786 --device 0:0 --device 0:1", "A worker on each of two devices."),
        ("clsplat compare SCENE -o table --cluster tcp://HOST:8786", "A comparison that the workers do."),
    ),
    see_also=("compare", "frontier", "benchmark", "train"),
)
@click.argument("address")
@click.option(
    "--device",
    "devices",
    multiple=True,
    metavar="SPEC",
    help='OpenCL device: "cpu", "gpu", an index such as 0:1, or part of a name. Repeat it for a worker on each.',
)
@click.option(
    "--workers",
    type=click.IntRange(1, 1000),
    metavar="N",
    help="Number of workers. Those on one CPU share its cores.  [default: one on each device]",
)
@quiet_option
def start_workers(address: str, devices: tuple[str, ...], workers: int | None, quiet: bool) -> None:
    """Do training runs of other commands on this machine's devices, as the scheduler at ADDRESS hands them out.

    ADDRESS is that of a scheduler of dask.distributed, such as tcp://HOST:8786, or its scheduler file. The command
    `dask scheduler` starts one on any machine. Scenes and results must be at the same paths on all machines, for
    example on a shared disk.

    The workers do one run at a time, until the scheduler ends or Ctrl-C is pressed. A run that this cuts short goes on
    elsewhere, from its last checkpoint.

    Whoever reaches the scheduler can run any code on all of its machines: use it in networks that you trust.
    """
    from clsplat.cluster.address import ClusterAddress
    from clsplat.cluster.dask import scheduler_address
    from clsplat.cluster.workers import WorkerPlan, plan_workers, serve
    from clsplat.errors import InputError

    place = ClusterAddress.parse(address)
    if place.is_local:
        raise InputError(f"{address}: has no scheduler to work for: commands start such workers themselves")
    target = scheduler_address(place)
    plans = plan_workers(devices or (None,), workers)

    def ready(plan: WorkerPlan) -> None:
        if not quiet:
            cores = "" if plan.cores is None else f", {len(plan.cores)} of the cores"
            click.echo(f"worker {plan.name}: waits for runs of {target}, device {plan.device}{cores}", err=True)

    serve(target, plans, ready)
    if not quiet:
        click.echo(f"{target}: the scheduler has ended", err=True)
