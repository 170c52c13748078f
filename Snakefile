# A recorded drive of nuScenes into 3D Gaussian splats, and what that is worth on held-out frames.
#
#   snakemake --cores 1 results/0103/metrics.json     one scene, every configured method
#   snakemake --cores 4                               all scenes, and the report across them
#   snakemake --cores 2 results/demo/metrics.json     the synthetic demo world: no dataset, no GPU
#   snakemake --cores 1 gap_report                    the report over what has been measured
#
# rules/ says what depends on what, workflow_scripts/ calls one library function a rule, drivesplat/ is the library.
from snakemake.utils import min_version

min_version("9.27")


configfile: "config.yaml"


include: "rules/common.smk"
include: "rules/demo.smk"
include: "rules/scene.smk"
include: "rules/train.smk"
include: "rules/measure.smk"
include: "rules/report.smk"


rule all:
    default_target: True
    input:
        expand("<results>/{scene}/metrics.json", scene=plan.config.batch_scenes),
        "<results>/gap_report.csv",


rule metrics:
    input:
        expand("<results>/{scene}/metrics.json", scene=plan.config.batch_scenes),
