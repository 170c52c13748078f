# Long drives: cut into blocks along the path, each of which is a scene that the other rules train and measure; and the
# results of the drive, made from those of its blocks.
#
# REQUIRED INPUTS: <results>/{scene}/scene.json of a drive of a dataset with `blocks`.
# OUTPUTS: <results>/{scene}/blocks.json; of every block <results>/{scene}.{number}/scene.json, from which the rules of
# scenes go on; of the drive {method}/eval.json, eval_objects.json, films, films of edits, splats/, scene.usd with usd/,
# and viewer.html.

long_drives = LongDrives(plan, lambda drive: checkpoints.blocks.get(scene=drive).output.blocks)


checkpoint blocks:
    """
    Cuts a drive into blocks along its path: places that the vehicle passes again belong to the block of the first time.
    """
    input:
        scene=plan.annotated_scene,
    output:
        blocks="<results>/{scene}/blocks.json",
    log:
        "<logs>/{scene}/blocks.log",
    benchmark:
        "<benchmarks>/{scene}/blocks.tsv"
    wildcard_constraints:
        scene=plan.cut,
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("blocks"),
        code=plan.code("blocks"),
    script:
        "../workflow_scripts/blocks.py"


rule block:
    """
    Makes the scene of a block from that of its drive. A block whose recordings have not changed is not made again.
    """
    input:
        ancient(long_drives.inputs_of_block),
    output:
        scene="<results>/{scene}/scene.json",
    log:
        "<logs>/{scene}/block.log",
    benchmark:
        "<benchmarks>/{scene}/block.tsv"
    wildcard_constraints:
        scene=plan.blocks,
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("block"),
        recordings=long_drives.digest,
        code=plan.code("block"),
    script:
        "../workflow_scripts/block.py"


rule evaluate_blocks:
    """
    Combines the measurements of all blocks of a drive: the pixels of all held-out images count alike.
    """
    input:
        scene=plan.annotated_scene,
        blocks="<results>/{scene}/blocks.json",
        evals=long_drives.results("{method}/eval.json"),
        objects=long_drives.results("{method}/eval_objects.json"),
    output:
        metrics="<results>/{scene}/{method}/eval.json",
        objects="<results>/{scene}/{method}/eval_objects.json",
    log:
        "<logs>/{scene}/{method}/evaluate_blocks.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/evaluate_blocks.tsv"
    wildcard_constraints:
        scene=plan.cut,
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("evaluate_blocks"),
        code=plan.code("evaluate_blocks"),
    script:
        "../workflow_scripts/evaluate_blocks.py"


rule film_blocks:
    """
    Renders a film of a drive, block after block. Near a border the images of both blocks are blended.
    """
    input:
        scene=plan.annotated_scene,
        blocks="<results>/{scene}/blocks.json",
        scenes=long_drives.results("scene.json"),
        checkpoints=long_drives.results("{method}/checkpoint.npz"),
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
        scene=plan.cut,
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=240,
    params:
        settings=plan.settings("film_blocks"),
        code=plan.code("film_blocks"),
    script:
        "../workflow_scripts/film_blocks.py"


rule edit_blocks:
    """
    Renders an edited drive beside the recorded one, block after block, each with the objects that it has learned.
    """
    input:
        scene=plan.annotated_scene,
        blocks="<results>/{scene}/blocks.json",
        scenes=long_drives.results("scene.json"),
        checkpoints=long_drives.results("{method}/checkpoint.npz"),
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
        scene=plan.cut,
        method=plan.known(plan.methods_with_actors),
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=8)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=240,
    params:
        settings=plan.settings("edit_blocks"),
        code=plan.code("edit_blocks"),
    script:
        "../workflow_scripts/edit_blocks.py"


rule export_blocks:
    """
    Exports the static Gaussians of a drive as one PLY for each block, in which no place stands twice, with an index.
    """
    input:
        scene=plan.annotated_scene,
        blocks="<results>/{scene}/blocks.json",
        checkpoints=long_drives.results("{method}/checkpoint.npz"),
    output:
        index="<results>/{scene}/{method}/splats/splats.json",
    log:
        "<logs>/{scene}/{method}/export_blocks.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/export_blocks.tsv"
    wildcard_constraints:
        scene=plan.cut,
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("export_blocks"),
        code=plan.code("export_blocks"),
    script:
        "../workflow_scripts/export_blocks.py"


rule usd_blocks:
    """
    Exports a drive as an OpenUSD stage with a payload for each block, in which no Gaussian stands twice.
    """
    input:
        scene=plan.annotated_scene,
        blocks="<results>/{scene}/blocks.json",
        scenes=long_drives.each(plan.scene),
        checkpoints=long_drives.results("{method}/checkpoint.npz"),
        far=long_drives.results("{method}/far.npz"),
    output:
        usd="<results>/{scene}/{method}/scene.usd",
    log:
        "<logs>/{scene}/{method}/usd_blocks.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/usd_blocks.tsv"
    wildcard_constraints:
        scene=plan.cut,
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=8000,
        runtime=120,
    params:
        settings=plan.settings("usd_blocks"),
        code=plan.code("usd_blocks"),
    script:
        "../workflow_scripts/usd_blocks.py"


rule viewer_blocks:
    """
    Writes a map of a drive's path, coloured by the figures of its blocks, that leads to the viewers of these.
    """
    input:
        scene=plan.annotated_scene,
        blocks="<results>/{scene}/blocks.json",
        scenes=long_drives.results("scene.json"),
        metrics="<results>/{scene}/{method}/eval.json",
        viewers=long_drives.results("{method}/viewer.html"),
    output:
        # not in Snakemake's report, whose archive lacks the pages that it leads to
        viewer="<results>/{scene}/{method}/viewer.html",
    log:
        "<logs>/{scene}/{method}/viewer_blocks.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/viewer_blocks.tsv"
    wildcard_constraints:
        scene=plan.cut,
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("viewer_blocks"),
        code=plan.code("viewer_blocks"),
    script:
        "../workflow_scripts/viewer_blocks.py"
