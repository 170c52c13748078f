# Edited drives: vehicles removed, moved, slowed or scaled, and the ego vehicle on another path.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/checkpoint.npz of a method with actors, scene.json; the scene's edits file,
# named by datasets.<name>.edits, is read while planning: a changed edit reruns, its neighbours in the file do not. The
# assets that the edit inserts: <results>/{scene}/{method}/assets/assets.json, or asset.json of folders elsewhere.
# OUTPUTS: <results>/{scene}/{method}/edits/{edit}.mp4, {edit}.png and {edit}.json; {edit}/ with frames, where wanted;
# <results>/{scene}/{method}/quad/{edit}.mp4 and {edit}.json, on request; likewise
# <results>/{scene}/{method}/edits/{edit}/drive/ and trajectories/{trajectory}/drive/, with drive.json; and scans/ beside
# drive/, with scans.json, of methods that render LiDAR. <results>/{scene}/{method}/assets/ with assets.json, and a folder
# for each actor: asset.ply, asset.json and turntable.webp.


rule edit:
    """
    Renders an edited drive beside the recorded one as a film, and writes the poses and boxes of every frame: labels of
    images that were never recorded.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        inserts=plan.inserts,
        frames=plan.recorded_frames,
    output:
        film=report(
            "<results>/{scene}/{method}/edits/{edit}.mp4",
            caption="../report/edit.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "edit: {edit} (film)"},
        ),
        still=report(
            "<results>/{scene}/{method}/edits/{edit}.png",
            caption="../report/edit.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "edit: {edit} (still)"},
        ),
        labels="<results>/{scene}/{method}/edits/{edit}.json",
    log:
        "<logs>/{scene}/{method}/edit_{edit}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/edit_{edit}.tsv"
    wildcard_constraints:
        scene=plan.trained(),
        method=plan.known(plan.methods_with_actors),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("edit"),
        code=plan.code("edit"),
    script:
        "../workflow_scripts/edit.py"


rule quad:
    """
    Renders a drive in four panels of one film: its recorded images, their reconstruction, the smooth drive between
    them, and an edit of it.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        inserts=plan.inserts,
        frames=plan.recorded_frames,
    output:
        film=report(
            "<results>/{scene}/{method}/quad/{edit}.mp4",
            caption="../report/quad.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "film: recorded, reconstructed, smooth, edited ({edit})"},
        ),
        labels="<results>/{scene}/{method}/quad/{edit}.json",
    log:
        "<logs>/{scene}/{method}/quad_{edit}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/quad_{edit}.tsv"
    wildcard_constraints:
        method=plan.known(plan.methods_with_actors),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("quad"),
        code=plan.code("quad"),
    script:
        "../workflow_scripts/quad.py"


rule drive_folder:
    """
    Renders an edited drive, or one beside the recorded path, as a dataset: images of all cameras at their own times,
    with poses, calibration and boxes, as a drive folder and as nuScenes tables.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        inserts=plan.inserts,
    output:
        drive="<results>/{scene}/{method}/{kind}/{drive}/drive/drive.json",
    log:
        "<logs>/{scene}/{method}/drive_folder_{kind}_{drive}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/drive_folder_{kind}_{drive}.tsv"
    wildcard_constraints:
        kind="edits|trajectories",
        drive="[^/]+",
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("drive_folder"),
        code=plan.code("drive_folder"),
    script:
        "../workflow_scripts/drive_folder.py"


rule scan_folder:
    """
    Renders the LiDAR scans of an edited drive, or of one beside the recorded path: the recorded rays from where the
    sensor now is, with ranges, intensities, drops, and the object that each return belongs to.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        scans="<results>/{scene}/scans.npz",
        inserts=plan.inserts,
    output:
        scans="<results>/{scene}/{method}/{kind}/{drive}/scans/scans.json",
    log:
        "<logs>/{scene}/{method}/scan_folder_{kind}_{drive}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/scan_folder_{kind}_{drive}.tsv"
    wildcard_constraints:
        kind="edits|trajectories",
        drive="[^/]+",
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("scan_folder"),
        code=plan.code("scan_folder"),
    script:
        "../workflow_scripts/scan_folder.py"


rule actor_assets:
    """
    Writes the actors of a trained model as assets: files of their Gaussians that edits of any drive insert and that
    other programs read, with a turntable of each.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        objects="<results>/{scene}/{method}/eval_objects.json",
    output:
        index="<results>/{scene}/{method}/assets/assets.json",
    log:
        "<logs>/{scene}/{method}/actor_assets.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/actor_assets.tsv"
    wildcard_constraints:
        method=plan.known(plan.methods_with_actors),
    conda:
        "../envs/drivesplat.yaml"
    threads: 2
    resources:
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("actor_assets"),
        code=plan.code("actor_assets"),
    script:
        "../workflow_scripts/actor_assets.py"
