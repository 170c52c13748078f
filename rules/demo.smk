# Synthetic worlds: a start without a dataset, with ground truth that recorded drives lack.
#
# REQUIRED INPUTS: none.
# OUTPUTS: the tables of a nuScenes dataset at the dataset's dataroot; samples/, maps/ and truth/ beside them, and sweeps/
# where sensors record between key frames. With a route, stretches/ has what a longer drive keeps.

for dataset in plan.worlds:

    rule:
        """
        Builds a street from its settings, drives the nuScenes rig along it and casts every image and LiDAR sweep ray
        by ray, with boxes, poses and calibration as nuScenes states them.
        """
        name:
            f"demo_world_{dataset}"
        output:
            tables=plan.world_tables(dataset),
            truth=plan.truth_file(dataset),
        log:
            f"<logs>/demo_world/{dataset}.log",
        benchmark:
            f"<benchmarks>/demo_world/{dataset}.tsv"
        conda:
            "../envs/drivesplat.yaml"
        threads: 16
        resources:
            mem_mb=6000,
            runtime=60,
        params:
            settings=plan.world_settings(dataset),
            code=plan.code("demo_world"),
        script:
            "../workflow_scripts/demo_world.py"
