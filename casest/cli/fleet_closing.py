"""`close MODEL DATASET --sensor COLUMN`: what the sensors of a data set have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from casest.cli.loading import asked_effects, declared_model
from casest.cli.shared import echo, progress, write
from casest.errors import UsageError

if TYPE_CHECKING:
    from casest.cli.options import CloseOptions


def fleet_closing(model_name: str, data: Sequence[str], options: CloseOptions) -> int:
    """Ask all sensors of a data set for effects that their model lacks; save, print."""
    from casest.cli.fleets import FleetOptions, planned
    from casest.diagnose.levels import LEVELS
    from casest.effects import CATALOGUE
    from casest.effects.kinds import foreign, readings
    from casest.fleet.calibrate_many import refuse_equations
    from casest.fleet.common import CHANCE
    from casest.report.html.common import PAGE, common_page
    from casest.report.text.fleet import common_text
    from casest.results.file import as_json
    from casest.results.fleet import COMMON, common_result
    from casest.tasks.common import common
    from casest.tasks.spread import own_sizes

    if len(data) != 1 or options.holdout or options.starts:
        raise UsageError(
            "--sensor: a fleet is one data set, whose halves are held out in turn: leave out "
            "further files, --holdout and --start"
        )
    _, own, _ = asked_effects(options.model.effects)
    model = declared_model(model_name, replace(options.model, effects=()))
    refuse_equations(model, "--sensor: what many have in common is asked of poses, not of")
    asked = FleetOptions(
        reading=options.reading,
        sensor=options.sensor or "sensor",
        keep=options.keep,
        output=options.output or Path("out"),
    )
    plan, job = planned(model, data[0], asked)
    units = dict(job.layout.units)
    read = [units.get(name) for name in readings(model)]
    catalogue = (*(e for e in CATALOGUE if not foreign(e, read)), *own)
    told = common(job, plan.partitions, catalogue, chance=CHANCE, clear=LEVELS.clear, say=progress)
    unseen = {name for name, _, seen in told.tried if not seen}
    spreads = own_sizes(
        job,
        plan.partitions,
        [e for e in catalogue if e.name not in unseen],
        told.effects,
        chance=CHANCE,
        apart=LEVELS.apart,
        say=progress,
    )
    result = common_result(job, told, spreads, data[0])
    if options.output:
        write(options.output / COMMON, as_json(result.content()))
        write(options.output / PAGE, common_page(result))
    if options.as_json:
        echo(as_json(result.content()), nl=False)
    else:
        echo(common_text(result, options.output), verdict=True)
    return 0
