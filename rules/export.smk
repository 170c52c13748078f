# Exports for other programs: the Gaussians, with the recorded trajectory.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/checkpoint.npz, scene.json, parser.npz.
# OUTPUTS: <results>/{scene}/{method}/splat.ply, cameras.json, transforms.json, parts/parts.json (and the PLYs beside
# it); scene.usdz; viewer.html; colmap/; splat.spz; splat.sog; scene.alpasim.usdz. `export.formats` says which of them
# `all` and `exports` make, `alpasim` makes the last. far.npz, which all of them but colmap/ and the last read.


rule far_gaussians:
    """
    Finds the Gaussians that lie too far away for other programs, and measures on all training views what leaving them
    out changes.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        parser=plan.of_tracks("parser.npz"),
    output:
        far="<results>/{scene}/{method}/far.npz",
    log:
        "<logs>/{scene}/{method}/far_gaussians.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/far_gaussians.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("far_gaussians"),
        code=plan.code("far_gaussians"),
    script:
        "../workflow_scripts/far_gaussians.py"


rule export:
    """
    Exports the Gaussians in 3DGS's PLY format, in one file and in one per part (background and each object), with the
    recorded cameras (also as nerfstudio reads them) and the motion of the objects.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        far="<results>/{scene}/{method}/far.npz",
        scene=plan.scene,
        parser=plan.of_tracks("parser.npz"),
    output:
        splat="<results>/{scene}/{method}/splat.ply",
        cameras="<results>/{scene}/{method}/cameras.json",
        transforms="<results>/{scene}/{method}/transforms.json",
        parts="<results>/{scene}/{method}/parts/parts.json",
    log:
        "<logs>/{scene}/{method}/export.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=15,
    params:
        settings=plan.settings("export"),
        code=plan.code("export"),
    script:
        "../workflow_scripts/export.py"


rule export_usd:
    """
    Exports the Gaussians in OpenUSD's Gaussian splat schema, with moving objects and the recording camera, for Omniverse
    and Isaac Sim.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        far="<results>/{scene}/{method}/far.npz",
        scene=plan.scene,
    output:
        usd="<results>/{scene}/{method}/scene.usdz",
    log:
        "<logs>/{scene}/{method}/export_usd.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export_usd.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=15,
    params:
        settings=plan.settings("export_usd"),
        code=plan.code("export_usd"),
    script:
        "../workflow_scripts/export_usd.py"


rule export_viewer:
    """
    Exports one HTML page that shows the splat interactively and offline, with a limited number of Gaussians, the
    recorded images at key frames and the edits of the scene.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        far="<results>/{scene}/{method}/far.npz",
        scene=plan.scene,
        parser=plan.of_tracks("parser.npz"),
    output:
        viewer=report(
            "<results>/{scene}/{method}/viewer.html",
            caption="../report/viewer.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "viewer"},
        ),
    log:
        "<logs>/{scene}/{method}/export_viewer.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export_viewer.tsv"
    wildcard_constraints:
        scene=plan.trained(),
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=15,
    params:
        settings=plan.settings("export_viewer"),
        code=plan.code("export_viewer"),
    script:
        "../workflow_scripts/export_viewer.py"


rule export_colmap:
    """
    Exports the recorded cameras and the seed points as a text model of COLMAP.
    """
    input:
        scene=plan.scene,
        parser=plan.of_tracks("parser.npz"),
    output:
        cameras="<results>/{scene}/{method}/colmap/cameras.txt",
        images="<results>/{scene}/{method}/colmap/images.txt",
        points="<results>/{scene}/{method}/colmap/points3D.txt",
    log:
        "<logs>/{scene}/{method}/export_colmap.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export_colmap.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=15,
    params:
        settings=plan.settings("export_colmap"),
        code=plan.code("export_colmap"),
    script:
        "../workflow_scripts/export_colmap.py"


rule export_spz:
    """
    Exports the Gaussians as a compressed file, a tenth of the PLY, for web viewers.
    """
    input:
        splat="<results>/{scene}/{method}/splat.ply",
    output:
        spz="<results>/{scene}/{method}/splat.spz",
    log:
        "<logs>/{scene}/{method}/export_spz.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export_spz.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=15,
    params:
        settings=plan.settings("export_spz"),
        code=plan.code("export_spz"),
    script:
        "../workflow_scripts/export_spz.py"


rule export_sog:
    """
    Exports the Gaussians as SOG, PlayCanvas's compressed format, by @playcanvas/splat-transform.
    """
    input:
        splat="<results>/{scene}/{method}/splat.ply",
    output:
        sog="<results>/{scene}/{method}/splat.sog",
    log:
        "<logs>/{scene}/{method}/export_sog.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export_sog.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: 4
    resources:
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("export_sog"),
        code=plan.code("export_sog"),
    script:
        "../workflow_scripts/export_sog.py"


rule export_alpasim:
    """
    Exports a scene that AlpaSim loads: the recorded path of the vehicle, its cameras, all tracks, the ground and a
    coarse mesh; with the drive itself, which `drivesplat serve` renders on another machine.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        parser=plan.of_tracks("parser.npz"),
        own_car=plan.of_images("own_car.json"),
        scans=plan.training_input("scans"),
    output:
        usdz="<results>/{scene}/{method}/scene.alpasim.usdz",
    log:
        "<logs>/{scene}/{method}/export_alpasim.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export_alpasim.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("export_alpasim"),
        code=plan.code("export_alpasim"),
    script:
        "../workflow_scripts/export_alpasim.py"
