# The training of one method on one scene.
#
# REQUIRED INPUTS: <results>/{scene}/parser.pkl with parser.npz and, of scenes with cameras, masks/masks.json; actors.npz,
# lidar_depth.npz and scans.npz if the method has actors, is supervised with LiDAR depth, and renders LiDAR; in
# discovered/ or unlabelled/ where the method has such tracks; of a block that starts from the one before it
# (`blocks.init`) parser.npz and checkpoint.npz of that one.
# OUTPUTS: <results>/{scene}/{method}/checkpoint.npz and train.json; tensorboard/ beside them. While a training
# runs, resume/ holds its resume checkpoint; no rule declares it, so that Snakemake does not delete it.


rule train:
    """
    Fits Gaussians to training images and LiDAR scans; resumes an interrupted training of the same settings, code and inputs.
    """
    input:
        pickle=plan.of_tracks("parser.pkl"),
        parser=plan.of_tracks("parser.npz"),
        masks=plan.of_images("masks/masks.json", of_tracks=True),
        actors=plan.training_input("actors"),
        lidar_depth=plan.training_input("lidar_depth"),
        scans=plan.training_input("scans"),
        previous_parser=long_drives.previous_parser,
        previous=long_drives.previous,
    output:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        summary="<results>/{scene}/{method}/train.json",
    log:
        "<logs>/{scene}/{method}/train.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/train.tsv"
    wildcard_constraints:
        scene=plan.trained(),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=2)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=plan.recordings.training_mb,
        runtime=240,
    params:
        settings=plan.settings("train"),
        code=plan.code("train"),
    script:
        "../workflow_scripts/train.py"
