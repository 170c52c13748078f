# Validation of the config and of the targets before any job; settings and code digests of rules.
#
# A rule's `params` are its settings (canonical JSON of its own subtree, defaults filled in) and the digest of its code.
# Snakemake compares only these, so key order, comments and settings of other stages rerun nothing.
import os
import sys

from snakemake.cli import get_argument_parser
from snakemake.utils import validate

sys.path.insert(0, workflow.basedir)

from drivesplat.workflow.costs.run_costs import COSTS, ESTIMATE, RunCosts
from drivesplat.errors import DriveSplatError
from drivesplat.workflow.plan import Plan, let_scripts_import

let_scripts_import(workflow.basedir)
asked = get_argument_parser().parse_known_args()[0]
wanted = [target for target in asked.targets if target != ESTIMATE]

if ESTIMATE in asked.targets and asked.no_hooks:
    sys.exit(f"drivesplat: --no-hooks leaves out what the target {ESTIMATE!r} is for, and would run everything")

try:
    plan = Plan(config, workflow.basedir)
    run_costs = RunCosts(plan, workflow, asked.targets)
    across_scenes = plan.report(wanted)
    plan.edits()
    if workflow.is_main_process and not asked.lint:
        plan.refuse_unknown(wanted)
        plan.refuse_download(wanted)
        across_scenes.refuse_empty()
        if wanted != [COSTS]:
            plan.refuse_absent_data(wanted)
        run_costs.report_settings_without_effect()
        run_costs.report_foreign_records()
except DriveSplatError as error:
    sys.exit(f"drivesplat: {error}")

validate(config, os.path.join(workflow.basedir, "config.schema.json"), set_default=False)


pathvars:
    results=plan.config.results_dir,
    logs=f"{plan.config.results_dir}/logs",
    benchmarks=f"{plan.config.results_dir}/benchmarks",


wildcard_constraints:
    scene=plan.known(plan.config.scenes),
    method=plan.known(plan.config.all_methods),
    trajectory=plan.known(plan.all_trajectories),
    edit="[A-Za-z0-9_][A-Za-z0-9_.-]*",
