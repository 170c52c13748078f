# Synthetic worlds: what a newcomer without a dataset starts from, with the truth that real logs lack.
#
# REQUIRED INPUTS: none.
# OUTPUTS: the tables of a nuScenes dataset at the dataset's dataroot; samples/, sweeps/, maps/ and truth/ beside them.


rule demo_world:
    """
    Builds a street from its settings, drives the nuScenes rig along it and casts every image and LiDAR sweep ray by
    ray, with boxes, poses and calibration as nuScenes states them.
    """
    output:
        tables=expand("{{tables}}/{table}.json", table=plan.world_tables),
    log:
        "<logs>/demo_world/{tables}.log",
    benchmark:
        "<benchmarks>/demo_world/{tables}.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: 16
    resources:
        mem_mb=6000,
        runtime=60,
    params:
        settings=plan.world_settings,
        code=plan.code("demo_world"),
    script:
        "../workflow_scripts/demo_world.py"
