# Preprocessing: from a dataset's tables to the inputs of a training.
#
# REQUIRED INPUTS: the tables, images and LiDAR of the dataset that the config names.
# OUTPUTS: <results>/{scene}/scene.json, own_car.json, seed.ply, parser.pkl and parser.npz, masks/masks.json (and the PNGs beside it);
# where the settings name a segmentation network, segmented/masks.json (and the PNGs beside it); where poses are refined, scene_refined.json, poses.json and triangulated.npz; where a method asks for them, actors.npz,
# lidar_depth.npz and scans.npz; light.json for edits that insert objects. The scene of all rules after these (plan.scene) is the refined one where there is one.
# What depends on tracks is made for each kind of tracks that methods train with (tracks.smk): the wildcard {tracks} is
# empty for annotated ones, else the folder 'discovered/' or 'unlabelled/'.


rule extract:
    """
    Reads a scene's rows of the dataset's tables and checks them: cameras, LiDAR sweeps and object tracks in one world
    frame, every image with the ego pose of its own timestamp.
    """
    input:
        tables=plan.tables,
        scene_tables=plan.scene_tables,
    output:
        scene="<results>/{scene}/scene.json",
    log:
        "<logs>/{scene}/extract.log",
    benchmark:
        "<benchmarks>/{scene}/extract.tsv"
    wildcard_constraints:
        scene=plan.known(plan.config.scenes),
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=2000,
        runtime=30,
        track_references=plan.track_references,
    params:
        settings=plan.settings("extract"),
        root=plan.root,
        code=plan.code("extract"),
    script:
        "../workflow_scripts/extract.py"


rule own_car:
    """
    Finds the pixels of the ego vehicle in each camera: from the user's outlines, or as the pixels that do not change
    while the vehicle drives.
    """
    input:
        scene="<results>/{scene}/scene.json",
    output:
        own_car="<results>/{scene}/own_car.json",
    log:
        "<logs>/{scene}/own_car.log",
    benchmark:
        "<benchmarks>/{scene}/own_car.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=15,
    params:
        settings=plan.settings("own_car"),
        code=plan.code("own_car"),
    script:
        "../workflow_scripts/own_car.py"


rule refine_poses:
    """
    Refines poses: LiDAR sweeps are registered to each other, then images are adjusted together with triangulated
    features. Keeps the given poses, with a warning, where withheld measurements do not improve. Can also estimate poses
    from images and LiDAR alone, and fails if these do not determine them.
    """
    input:
        scene="<results>/{scene}/scene.json",
        own_car=plan.of_images("own_car.json"),
    output:
        scene="<results>/{scene}/scene_refined.json",
        poses="<results>/{scene}/poses.json",
        points="<results>/{scene}/triangulated.npz",
    log:
        "<logs>/{scene}/refine_poses.log",
    benchmark:
        "<benchmarks>/{scene}/refine_poses.tsv"
    wildcard_constraints:
        scene=plan.known(plan.config.scenes),
    conda:
        "../envs/drivesplat.yaml"
    threads: 4
    resources:
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("refine_poses"),
        code=plan.code("refine_poses"),
    script:
        "../workflow_scripts/refine_poses.py"


rule lidar_seed:
    """
    Makes seed points from static LiDAR returns of the training sweeps, coloured from training images, and random far
    points along pixels that LiDAR does not reach.
    """
    input:
        scene=plan.scene,
        own_car="<results>/{scene}/own_car.json",
        points_file=plan.points_file,
        triangulated=plan.triangulated,
    output:
        seed="<results>/{scene}/{tracks}seed.ply",
    log:
        "<logs>/{scene}/{tracks}lidar_seed.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}lidar_seed.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: 4
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
    Combines cameras, splits and seed into the training record that all later stages read, and writes it once more as
    the dictionary of gsplat's example trainer. Scenes without cameras have the splits alone.
    """
    input:
        scene=plan.scene,
        seed=plan.of_images("seed.ply", of_tracks=True),
    output:
        pickle="<results>/{scene}/{tracks}parser.pkl",
        parser="<results>/{scene}/{tracks}parser.npz",
    log:
        "<logs>/{scene}/{tracks}parser.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}parser.tsv"
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


rule segment:
    """
    Makes class maps, sky masks and vehicle masks of all images by a segmentation network. Runs only where the settings
    name one (segment.model), and downloads nothing.
    """
    input:
        scene=plan.annotated_scene,
        network=plan.network_files,
    output:
        maps="<results>/{scene}/segmented/masks.json",
    log:
        "<logs>/{scene}/segment.log",
    benchmark:
        "<benchmarks>/{scene}/segment.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("segment"),
        code=plan.code("segment"),
    script:
        "../workflow_scripts/segment.py"


rule masks:
    """
    Labels every pixel of every image as static, parked, moving or ignored (from the annotated boxes), and as sky.
    """
    input:
        scene=plan.scene,
        own_car="<results>/{scene}/own_car.json",
        # read as folders of the user's
        segmented=plan.segmented,
    output:
        masks="<results>/{scene}/masks/masks.json",
    log:
        "<logs>/{scene}/masks.log",
    benchmark:
        "<benchmarks>/{scene}/masks.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.mask_threads
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
    Collects LiDAR points of every visible moving vehicle in the vehicle's own frame, coloured from training images, with
    random points in its box where LiDAR is sparse.
    """
    input:
        scene=plan.scene,
        own_car=plan.of_images("own_car.json"),
    output:
        actors="<results>/{scene}/{tracks}actors.npz",
    log:
        "<logs>/{scene}/{tracks}actors.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}actors.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=15,
        track_references=plan.track_references,
    params:
        settings=plan.settings("actors"),
        code=plan.code("actors"),
    script:
        "../workflow_scripts/actors.py"


rule lidar_depth:
    """
    Projects the nearest LiDAR sweep into every training image, with moving points transformed by their tracks to the
    time of the image.
    """
    input:
        scene=plan.scene,
        own_car="<results>/{scene}/own_car.json",
    output:
        depth="<results>/{scene}/{tracks}lidar_depth.npz",
    log:
        "<logs>/{scene}/{tracks}lidar_depth.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}lidar_depth.tsv"
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


rule scans:
    """
    Resolves the revolutions of all LiDARs into rays: direction, time, range, intensity, whether they returned, which
    object they met, and which say nothing (the ego vehicle, skipped sectors).
    """
    input:
        scene=plan.scene,
    output:
        scans="<results>/{scene}/{tracks}scans.npz",
    log:
        "<logs>/{scene}/{tracks}scans.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}scans.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("scans"),
        code=plan.code("scans"),
    script:
        "../workflow_scripts/scans.py"


rule light:
    """
    Estimates the light of a scene, for the shadows of inserted objects: from those that recorded vehicles cast on the
    ground.
    """
    input:
        scene=plan.annotated_scene,
    output:
        light="<results>/{scene}/light.json",
    log:
        "<logs>/{scene}/light.log",
    benchmark:
        "<benchmarks>/{scene}/light.tsv"
    wildcard_constraints:
        scene=plan.trained(cameras=True),
    conda:
        "../envs/drivesplat.yaml"
    threads: 2
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("light"),
        code=plan.code("light"),
    script:
        "../workflow_scripts/light.py"
