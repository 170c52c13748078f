# Exports for other programs: the Gaussians, with the recorded trajectory.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/checkpoint.npz, scene.json, parser.pkl.
# OUTPUTS: <results>/{scene}/{method}/splat.ply, cameras.json, parts/parts.json (and the PLYs beside it); scene.usdz;
# viewer.html.


rule export:
    """
    Exports the Gaussians in 3DGS's PLY format, in one file and in one per part (background and each object), with the
    recorded cameras and the motion of the objects.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        parser="<results>/{scene}/parser.pkl",
    output:
        splat="<results>/{scene}/{method}/splat.ply",
        cameras="<results>/{scene}/{method}/cameras.json",
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
    Exports one HTML page that shows the splat interactively and offline, with a limited number of Gaussians.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
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
