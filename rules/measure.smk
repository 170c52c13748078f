# Measures trained methods on held-out images, by annotated tracks whatever a method trains with.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/checkpoint.npz, parser.npz; with cameras masks/, without scans.npz; where a
# method has discovered tracks discovered.json.
# OUTPUTS: <results>/{scene}/{method}/eval.json; eval_objects.json, held_out_recorded.png, held_out_rendered.png beside it;
# <results>/{scene}/metrics.json; where a method renders LiDAR <results>/{scene}/scan_baselines.json;
# resources/lpips/backbone.json.


rule lpips_backbone:
    """
    Downloads LPIPS's AlexNet backbone once, or uses the present file; if neither works, LPIPS is null with the reason
    and the run continues.
    """
    input:
        file=plan.backbone_file,
    output:
        record="<resources>/lpips/backbone.json",
    log:
        "<logs>/lpips_backbone.log",
    benchmark:
        "<benchmarks>/lpips_backbone.tsv"
    conda:
        "../envs/drivesplat.yaml"
    params:
        settings=plan.config.lpips.model_dump_json(),
        code=plan.code("lpips_backbone"),
    script:
        "../workflow_scripts/lpips_backbone.py"


rule evaluate:
    """
    Renders the held-out images of the evaluated camera and measures PSNR, SSIM and LPIPS over static and dynamic pixels;
    on a synthetic world also lateral views, their depth, and the removal of the leading car, compared with the ground
    truth. Writes one held-out image as recorded and as rendered.
    """
    input:
        scene=plan.annotated_scene,
        truth=plan.truth,
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        summary="<results>/{scene}/{method}/train.json",
        parser=plan.of_tracks("parser.npz"),
        masks="<results>/{scene}/masks/masks.json",
        scans=plan.measured_scans,
        lpips=plan.lpips_record,
    output:
        metrics="<results>/{scene}/{method}/eval.json",
        objects="<results>/{scene}/{method}/eval_objects.json",
        recorded="<results>/{scene}/{method}/held_out_recorded.png",
        rendered="<results>/{scene}/{method}/held_out_rendered.png",
    log:
        "<logs>/{scene}/{method}/evaluate.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/evaluate.tsv"
    wildcard_constraints:
        scene=plan.trained(cameras=True),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("evaluate"),
        code=plan.code("evaluate"),
    script:
        "../workflow_scripts/evaluate.py"


rule scan_baselines:
    """
    Measures held-out LiDAR scans made from other scans without a model: what a method that renders LiDAR has to beat.
    """
    input:
        scene=plan.annotated_scene,
        scans="<results>/{scene}/scans.npz",
    output:
        baselines="<results>/{scene}/scan_baselines.json",
    log:
        "<logs>/{scene}/scan_baselines.log",
    benchmark:
        "<benchmarks>/{scene}/scan_baselines.tsv"
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("scan_baselines"),
        code=plan.code("scan_baselines"),
    script:
        "../workflow_scripts/scan_baselines.py"


rule evaluate_scans:
    """
    Measures the held-out LiDAR scans of a scene without cameras.
    """
    input:
        scene=plan.annotated_scene,
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        summary="<results>/{scene}/{method}/train.json",
        parser=plan.of_tracks("parser.npz"),
        scans="<results>/{scene}/scans.npz",
    output:
        metrics="<results>/{scene}/{method}/eval.json",
    log:
        "<logs>/{scene}/{method}/evaluate_scans.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/evaluate_scans.tsv"
    wildcard_constraints:
        scene=plan.trained(cameras=False),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=30,
    params:
        settings=plan.settings("evaluate_scans"),
        code=plan.code("evaluate_scans"),
    script:
        "../workflow_scripts/evaluate_scans.py"


rule scene_metrics:
    """
    Combines the measurements of all methods of a scene, with the baselines of LiDAR scans where a method renders them,
    and the quality of discovered tracks where a method trains with them.
    """
    input:
        evals=plan.evals,
        baselines=plan.scan_baselines,
        discovered=plan.discovered,
    output:
        metrics=report(
            "<results>/{scene}/metrics.json",
            caption="../report/metrics.rst",
            category="Scene {scene}",
            subcategory="figures",
            labels={"what": "metrics of all methods"},
        ),
    log:
        "<logs>/{scene}/metrics.log",
    benchmark:
        "<benchmarks>/{scene}/metrics.tsv"
    conda:
        "../envs/drivesplat.yaml"
    params:
        settings=plan.settings("scene_metrics"),
        code=plan.code("scene_metrics"),
    script:
        "../workflow_scripts/scene_metrics.py"
