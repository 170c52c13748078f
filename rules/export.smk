# What leaves the workflow: the splat for other programs, with the trajectory it was recorded along.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/checkpoint.pt, scene.json, parser.pkl.
# OUTPUTS: <results>/{scene}/{method}/splat.ply, cameras.json, parts/parts.json (and the PLYs beside it); scene.usdz;
# viewer.html.


rule export:
    """
    The Gaussians as splat viewers read them (3DGS's PLY), together and a file for the background and every object, with
    every camera of the drive and how the objects move.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.pt",
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
    The Gaussians in OpenUSD's Gaussian splat schema, objects moving, with the recording camera: the drive as Omniverse
    and Isaac Sim play it.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.pt",
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
    One page that shows the splat under a mouse, without network; thinned to what a browser carries well.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.pt",
        scene=plan.scene,
    output:
        viewer="<results>/{scene}/{method}/viewer.html",
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
