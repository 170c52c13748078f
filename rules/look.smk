# Pictures and films of trained methods: trajectories, ghosts of moving vehicles, removal of a vehicle, LiDAR scans.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/checkpoint.npz, scene.json, parser.npz, masks/; actors.npz if a method has
# actors, scans.npz if it renders LiDAR.
# OUTPUTS: <results>/{scene}/tracks.csv and tracks.png, compare.mp4 and compare.json;
# <results>/{scene}/{method}/{trajectory}.mp4 and {trajectory}.cameras.json, of methods with actors parts.mp4 likewise;
# recorded_frames.npy, where films share it; of synthetic worlds truth.mp4 and truth.json; ghost_panel.png and .json;
# with_car.png, without_car.png, removal.png and removal.json; of methods that render LiDAR lidar.png, lidar.mp4 and
# lidar.json.


rule tracks:
    """
    Lists every annotated or discovered object that can move, with class, speed, visible time and whether it can be
    edited, and draws the moving ones with the ids that settings use.
    """
    input:
        scene=plan.scene,
        parser=plan.of_tracks("parser.npz"),
        masks=plan.of_tracks("masks/masks.json"),
        actors=plan.actors,
    output:
        table="<results>/{scene}/{tracks}tracks.csv",
        picture=report(
            "<results>/{scene}/{tracks}tracks.png",
            caption="../report/tracks.rst",
            category="Scene {scene}",
            subcategory="figures",
            labels={"what": "moving objects, with ids ({tracks}tracks.csv)"},
        ),
    log:
        "<logs>/{scene}/{tracks}tracks.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}tracks.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=10,
    params:
        settings=plan.settings("tracks"),
        code=plan.code("tracks"),
    script:
        "../workflow_scripts/tracks.py"


rule recorded_frames:
    """
    Renders the frames along the recorded path once for the films that show them beside others.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
    output:
        frames="<results>/{scene}/{method}/recorded_frames.npy",
    log:
        "<logs>/{scene}/{method}/recorded_frames.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/recorded_frames.tsv"
    wildcard_constraints:
        scene=plan.trained(),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("recorded_frames"),
        code=plan.code("recorded_frames"),
    script:
        "../workflow_scripts/recorded_frames.py"


rule film:
    """
    Renders a film along the recorded path or one beside it, at the speed of the drive.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        frames=plan.recorded_frames,
    output:
        film=report(
            "<results>/{scene}/{method}/{trajectory}.mp4",
            caption="../report/film.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "film: {trajectory}"},
        ),
        cameras="<results>/{scene}/{method}/{trajectory}.cameras.json",
    log:
        "<logs>/{scene}/{method}/film_{trajectory}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/film_{trajectory}.tsv"
    wildcard_constraints:
        scene=plan.trained(),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("film"),
        code=plan.code("film"),
    script:
        "../workflow_scripts/film.py"


rule film_parts:
    """
    Renders the recorded drive three times side by side: all parts, the static ones and the dynamic ones.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        frames=plan.recorded_frames,
    output:
        film=report(
            "<results>/{scene}/{method}/parts.mp4",
            caption="../report/parts.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "film: the parts"},
        ),
        cameras="<results>/{scene}/{method}/parts.cameras.json",
    log:
        "<logs>/{scene}/{method}/film_parts.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/film_parts.tsv"
    wildcard_constraints:
        method=plan.known(plan.methods_with_moving_parts),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("film_parts"),
        code=plan.code("film_parts"),
    script:
        "../workflow_scripts/film_parts.py"


rule truth_film:
    """
    Shows the true images of a synthetic world from beside the recorded path, the renderings with their PSNR, and their
    error, as a film.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.annotated_scene,
        parser=plan.of_tracks("parser.npz"),
        masks="<results>/{scene}/masks/masks.json",
        truth=plan.truth,
    output:
        film=report(
            "<results>/{scene}/{method}/truth.mp4",
            caption="../report/truth_film.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "film: from beside the path, with the truth"},
        ),
        figures="<results>/{scene}/{method}/truth.json",
    log:
        "<logs>/{scene}/{method}/truth_film.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/truth_film.tsv"
    wildcard_constraints:
        scene=plan.known(plan.worlds.values()),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("truth_film"),
        code=plan.code("truth_film"),
    script:
        "../workflow_scripts/truth_film.py"


rule compare:
    """
    Shows each recorded image of the evaluated camera, the renderings of all methods with their PSNR, and the error of
    the last one, as a film.
    """
    input:
        checkpoints=plan.checkpoints,
        scene=plan.annotated_scene,
        parser=plan.first_parser,
        masks="<results>/{scene}/masks/masks.json",
    output:
        film=report(
            "<results>/{scene}/compare.mp4",
            caption="../report/compare.rst",
            category="Scene {scene}",
            subcategory="figures",
            labels={"what": "film: all methods beside the recording"},
        ),
        figures="<results>/{scene}/compare.json",
    log:
        "<logs>/{scene}/compare.log",
    benchmark:
        "<benchmarks>/{scene}/compare.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("compare"),
        code=plan.code("compare"),
    script:
        "../workflow_scripts/compare.py"


rule ghost_panel:
    """
    Draws ground truth, rendering, error and ghosts of the moving vehicle with the most pixels: how a static model fails
    on dynamic objects.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.shown_scene,
        parser=plan.of_tracks("parser.npz"),
        masks=plan.shown_masks,
    output:
        panel=report(
            "<results>/{scene}/{method}/ghost_panel.png",
            caption="../report/ghost_panel.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "ghost panel"},
        ),
        figures="<results>/{scene}/{method}/ghost_panel.json",
    log:
        "<logs>/{scene}/{method}/ghost_panel.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/ghost_panel.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=15,
    params:
        settings=plan.settings("ghost_panel"),
        code=plan.code("ghost_panel"),
    script:
        "../workflow_scripts/ghost_panel.py"


rule remove_actor:
    """
    Removes that vehicle from the model, by its own Gaussians if the method has them, otherwise by its box, and reports
    the remaining holes, edges and ghosts.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.shown_scene,
        parser=plan.of_tracks("parser.npz"),
        masks=plan.shown_masks,
    output:
        with_car="<results>/{scene}/{method}/with_car.png",
        without_car="<results>/{scene}/{method}/without_car.png",
        triptych=report(
            "<results>/{scene}/{method}/removal.png",
            caption="../report/removal.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "removal of a vehicle"},
        ),
        figures="<results>/{scene}/{method}/removal.json",
    log:
        "<logs>/{scene}/{method}/remove_actor.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/remove_actor.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=15,
    params:
        settings=plan.settings("remove_actor"),
        code=plan.code("remove_actor"),
    script:
        "../workflow_scripts/remove_actor.py"


rule lidar_picture:
    """
    Draws a LiDAR scan of each held-out group, recorded and rendered: range image, error, intensity and drop.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.annotated_scene,
        scans="<results>/{scene}/scans.npz",
    output:
        picture=report(
            "<results>/{scene}/{method}/lidar.png",
            caption="../report/lidar_picture.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "LiDAR: held-out scans"},
        ),
    log:
        "<logs>/{scene}/{method}/lidar_picture.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/lidar_picture.tsv"
    wildcard_constraints:
        method=plan.known(plan.methods_with_lidar_in_any_scene),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=15,
    params:
        settings=plan.settings("lidar_picture"),
        code=plan.code("lidar_picture"),
    script:
        "../workflow_scripts/lidar_picture.py"


rule lidar_film:
    """
    Shows all LiDAR scans of the drive, recorded and rendered, as range images and from above, with the error, as a film.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.annotated_scene,
        scans="<results>/{scene}/scans.npz",
    output:
        film=report(
            "<results>/{scene}/{method}/lidar.mp4",
            caption="../report/lidar_film.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "film: LiDAR scans"},
        ),
        figures="<results>/{scene}/{method}/lidar.json",
    log:
        "<logs>/{scene}/{method}/lidar_film.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/lidar_film.tsv"
    wildcard_constraints:
        method=plan.known(plan.methods_with_lidar_in_any_scene),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("lidar_film"),
        code=plan.code("lidar_film"),
    script:
        "../workflow_scripts/lidar_film.py"


rule edit_truth:
    """
    Compares an edited drive with the truth of a synthetic world in which the edit happened: the errors of inserted
    objects, of their shadows, and of the rest of the image; and of LiDAR, if the method renders it.
    """
    input:
        scene=plan.annotated_scene,
        truth=plan.truth,
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        parser=plan.of_tracks("parser.npz"),
        scans=plan.measured_scans,
        masks="<results>/{scene}/masks/masks.json",
        inserts=plan.inserts,
    output:
        figures="<results>/{scene}/{method}/edit_truth/{edit}.json",
        picture="<results>/{scene}/{method}/edit_truth/{edit}.png",
    log:
        "<logs>/{scene}/{method}/edit_truth_{edit}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/edit_truth_{edit}.tsv"
    wildcard_constraints:
        scene=plan.known(plan.worlds.values()),
        method=plan.known(plan.methods_with_actors),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("edit_truth"),
        code=plan.code("edit_truth"),
    script:
        "../workflow_scripts/edit_truth.py"
