# Turns a recorded drive into 3D Gaussian splats and measures them on held-out frames.
#
#   snakemake --cores 1 results/0103/metrics.json     one scene, every configured method
#   snakemake --cores 4                               all scenes: metrics, films, panels, exports, and the report
#   snakemake --cores 4 metrics                       the figures alone; `films`, `edits`, `looks`, `exports` likewise
#   snakemake --cores 4 drives                        rendered drives as datasets, of every edit and trajectory
#   snakemake --cores 4 runs                          policies that drive in the drives, of the runs file
#   snakemake --cores 4 mcap                          the drives as rendered, edits and runs as MCAP files for ROS 2
#   snakemake --cores 4 assets                        the actors of every method as assets, to insert into other drives
#   snakemake --cores 4 alpasim                       scenes that the simulator AlpaSim loads
#   snakemake --cores 1 report                        results/gap_report.html of what has been measured
#   snakemake --cores 1 results/0061/ablation.csv     the contribution of each component of `street`, with three seeds
#   snakemake --cores 4 estimate                      what all of it would take in time and disk, and how that is known
#   snakemake --cores 1 costs                         results/costs.csv of what has run
#   snakemake --report report.zip                     all there is to look at, as a page that opens offline
#
# The data, once you have accepted nuScenes' terms (docs/data.md):
#   snakemake --cores 1 --config accept_nuscenes_terms=True -- download_nuscenes_mini
#
# The demo world needs no dataset and no GPU:
#   snakemake --cores 2 results/demo/metrics.json
#   snakemake --cores 2 --configfile presets/demo.yaml -- all
#
# rules/ says what depends on what, workflow_scripts/ calls one library function a rule, drivesplat/ is the library.
import os

from snakemake.utils import min_version

min_version("9.27")


# not workflow.basedir: another workflow may import this one as a module
here = workflow.current_basedir.get_path_or_uri(secret_free=True)
main = workflow.modifier.is_main_snakefile()


configfile: "config.yaml" if main and os.path.isfile("config.yaml") else os.path.join(here, "config.yaml")


report: "report/workflow.rst"


include: "rules/common.smk"
include: "rules/download.smk"
include: "rules/demo.smk"
include: "rules/scene.smk"
include: "rules/tracks.smk"
include: "rules/blocks.smk"
include: "rules/train.smk"
include: "rules/measure.smk"
include: "rules/look.smk"
include: "rules/edit.smk"
include: "rules/run.smk"
include: "rules/export.smk"
include: "rules/mcap.smk"
include: "rules/report.smk"
include: "rules/ablation.smk"


rule metrics:
    input:
        plan.metrics,


rule films:
    input:
        plan.films,
        film_pages.pages,


rule edits:
    input:
        plan.edits,


rule drives:
    input:
        plan.drives,


rule assets:
    input:
        plan.assets,


rule runs:
    input:
        plan.runs,


rule mcap:
    input:
        plan.mcap_files,


rule looks:
    input:
        plan.looks,


rule exports:
    input:
        plan.exports,


rule alpasim:
    input:
        plan.alpasim,


rule report:
    input:
        rules.gap_report.output,


rule all:
    default_target: True
    input:
        rules.metrics.input,
        rules.films.input,
        rules.edits.input,
        rules.runs.input,
        rules.looks.input,
        rules.exports.input,
        rules.gap_report.output,


if main:

    include: "rules/hooks.smk"
