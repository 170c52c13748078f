# Validation of the config and of the targets before any job; settings and code digests of rules.
#
# A rule's `params` are its settings (canonical JSON of its own subtree, defaults filled in) and the digest of its code.
# Snakemake compares only these, so key order, comments and settings of other stages rerun nothing.
#
# As a module of another workflow this one knows no targets: the command line is the other's.
import os
import sys

from snakemake.cli import get_argument_parser
from snakemake.logging import logger as snakemake_logger
from snakemake.utils import validate

sys.path.insert(0, here)

from drivesplat.settings.config import in_current_names
from drivesplat.workflow.costs.run_costs import COSTS, ESTIMATE, RunCosts
from drivesplat.errors import DriveSplatError
from drivesplat.io.this_copy import in_this_copy
from drivesplat.workflow.long_drives import LongDrives
from drivesplat.workflow.module_use import module_config, stop_at_absent_data, take_prefix
from drivesplat.workflow.named_tracks import run_targets
from drivesplat.workflow.plan import Plan, let_scripts_import
from drivesplat.workflow.snakemake_log import name_changes, when_planned

let_scripts_import(here)
snakemake_logger.addFilter(name_changes)
asked = get_argument_parser().parse_known_args(None if main else [])[0]
wanted = [target for target in asked.targets if target != ESTIMATE]

if ESTIMATE in asked.targets and asked.no_hooks:
    sys.exit(f"drivesplat: --no-hooks leaves out what the target {ESTIMATE!r} is for, and would run everything")

try:
    prefix = "" if main else take_prefix(workflow)
    if not main:
        config = module_config(config, os.path.join(here, "config.yaml"), prefix)
    config, notes = in_current_names(config)
    for note in notes if workflow.is_main_process else ():
        print(f"drivesplat: {note}", file=sys.stderr)
    plan = Plan(config, here, prefix, workflow.is_main_process)
    if not main:
        stop_at_absent_data(plan)
    plan.targets = run_targets(wanted, workflow.is_main_process) if main else None
    run_costs = RunCosts(plan, workflow, asked.targets)
    across_scenes = plan.report(wanted)
    film_pages = plan.film_pages()
    plan.edits()
    if main and workflow.is_main_process and not asked.lint:
        plan.refuse_unknown(wanted)
        plan.refuse_download(wanted)
        across_scenes.refuse_empty()
        film_pages.refuse_empty(wanted)
        if wanted != [COSTS]:
            plan.refuse_absent_data(wanted)
        run_costs.report_at_planning()
except DriveSplatError as error:
    sys.exit(f"drivesplat: {in_this_copy(str(error))}")

validate(config, os.path.join(here, "config.schema.json"), set_default=False)


pathvars:
    results=plan.config.results_dir,
    resources=os.path.join(prefix, "resources"),
    logs=f"{plan.config.results_dir}/logs",
    benchmarks=f"{plan.config.results_dir}/benchmarks",


if workflow.pathvars.get("results") != plan.config.results_dir:
    sys.exit("drivesplat: pathvars of another workflow move results; use a prefix, or results_dir in the config")


wildcard_constraints:
    scene="|".join([plan.known(plan.config.scenes), plan.blocks]),
    method=plan.known(plan.config.all_methods),
    tracks=plan.known(["", *plan.other_tracks]),
    trajectory=plan.known(plan.all_trajectories),
    edit="[A-Za-z0-9_][A-Za-z0-9_.-]*",
    run="[A-Za-z0-9_][A-Za-z0-9_.-]*",
