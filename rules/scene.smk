# From a dataset's tables to what a training needs.
#
# REQUIRED INPUTS: the tables, images and LiDAR of the dataset that the config names.
# OUTPUTS: <results>/{scene}/scene.json, seed.ply, parser.pkl, masks/masks.json (and the PNGs beside it); where a method
# asks for them, actors.pkl, lidar_depth.pkl and free_space.pkl.


rule extract:
    """
    Reads the dataset's tables once and checks them: cameras, LiDAR sweeps and object tracks in one world frame,
    every image with the ego pose of its own timestamp.
    """
    input:
        tables=plan.tables,
    output:
        scene="<results>/{scene}/scene.json",
    log:
        "<logs>/{scene}/extract.log",
    benchmark:
        "<benchmarks>/{scene}/extract.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("extract"),
        code=plan.code("extract"),
    script:
        "../workflow_scripts/extract.py"


rule lidar_seed:
    """
    Starts the Gaussians where LiDAR of the training key frames found something that stands still, coloured from
    training images, with random far points along pixels that LiDAR does not reach.
    """
    input:
        scene="<results>/{scene}/scene.json",
        points_file=plan.points_file,
    output:
        seed="<results>/{scene}/seed.ply",
    log:
        "<logs>/{scene}/lidar_seed.log",
    benchmark:
        "<benchmarks>/{scene}/lidar_seed.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("lidar_seed"),
        code=plan.code("lidar_seed"),
    script:
        "../workflow_scripts/lidar_seed.py"


rule parser:
    """
    Packs cameras, splits and seed into the dict that users of gsplat's example trainer will recognise.
    """
    input:
        scene="<results>/{scene}/scene.json",
        seed="<results>/{scene}/seed.ply",
    output:
        parser="<results>/{scene}/parser.pkl",
    log:
        "<logs>/{scene}/parser.log",
    benchmark:
        "<benchmarks>/{scene}/parser.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=10,
    params:
        settings=plan.settings("parser"),
        code=plan.code("parser"),
    script:
        "../workflow_scripts/parser.py"


rule masks:
    """
    Labels every pixel of every image: static, parked, moving, left out (from the annotated boxes), and sky.
    """
    input:
        scene="<results>/{scene}/scene.json",
    output:
        masks="<results>/{scene}/masks/masks.json",
    log:
        "<logs>/{scene}/masks.log",
    benchmark:
        "<benchmarks>/{scene}/masks.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("masks"),
        code=plan.code("masks"),
    script:
        "../workflow_scripts/masks.py"


rule actors:
    """
    Gathers LiDAR of every vehicle that moves and is seen in that vehicle's own frame, coloured from training images,
    with random points in its box where LiDAR is thin.
    """
    input:
        scene="<results>/{scene}/scene.json",
    output:
        actors="<results>/{scene}/actors.pkl",
    log:
        "<logs>/{scene}/actors.log",
    benchmark:
        "<benchmarks>/{scene}/actors.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=15,
    params:
        settings=plan.settings("actors"),
        code=plan.code("actors"),
    script:
        "../workflow_scripts/actors.py"


rule lidar_depth:
    """
    Projects the LiDAR sweep nearest in time into every training image, what moves carried along to the image's moment.
    """
    input:
        scene="<results>/{scene}/scene.json",
    output:
        depth="<results>/{scene}/lidar_depth.pkl",
    log:
        "<logs>/{scene}/lidar_depth.log",
    benchmark:
        "<benchmarks>/{scene}/lidar_depth.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=15,
    params:
        settings=plan.settings("lidar_depth"),
        code=plan.code("lidar_depth"),
    script:
        "../workflow_scripts/lidar_depth.py"


rule free_space:
    """
    Follows every LiDAR ray of the training key frames from sensor to return: the voxels that rays passed, and near
    which none ended, are empty.
    """
    input:
        scene="<results>/{scene}/scene.json",
    output:
        free_space="<results>/{scene}/free_space.pkl",
    log:
        "<logs>/{scene}/free_space.log",
    benchmark:
        "<benchmarks>/{scene}/free_space.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=15,
    params:
        settings=plan.settings("free_space"),
        code=plan.code("free_space"),
    script:
        "../workflow_scripts/free_space.py"
