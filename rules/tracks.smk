# Other tracks than the annotated ones: objects that move, found in LiDAR scans, or none.
#
# REQUIRED INPUTS: <results>/{scene}/scene.json, scans.npz and masks/.
# OUTPUTS: <results>/{scene}/discovered.json; <results>/{scene}/discovered/ and unlabelled/, each with scene.json and
# masks/. The rules of scene.smk make all else there that depends on tracks.


rule discover:
    """
    Finds objects that move in the LiDAR scans of a drive, without labels, and compares them with annotated ones.
    """
    input:
        scene=plan.annotated_scene,
        scans="<results>/{scene}/scans.npz",
    output:
        tracks="<results>/{scene}/discovered.json",
    log:
        "<logs>/{scene}/discover.log",
    benchmark:
        "<benchmarks>/{scene}/discover.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: 4
    resources:
        mem_mb=4000,
        runtime=60,
    params:
        settings=plan.settings("discover"),
        code=plan.code("discover"),
    script:
        "../workflow_scripts/discover.py"


rule relabel:
    """
    Replaces the annotated tracks of a scene: by those that were discovered in it, or by none.
    """
    input:
        scene=plan.annotated_scene,
        discovered=plan.discovered,
    output:
        scene="<results>/{scene}/{tracks}scene.json",
    log:
        "<logs>/{scene}/{tracks}relabel.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}relabel.tsv"
    wildcard_constraints:
        tracks=plan.known(plan.other_tracks),
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=2000,
        runtime=10,
        track_references=plan.track_references,
    params:
        settings=plan.settings("relabel"),
        code=plan.code("relabel"),
    script:
        "../workflow_scripts/relabel.py"


rule regions:
    """
    Labels the pixels of every image by other tracks than the annotated ones; sky, classes and the ego vehicle are those
    of the rule masks, as links to the same files.
    """
    input:
        scene=plan.scene,
        masks="<results>/{scene}/masks/masks.json",
    output:
        masks="<results>/{scene}/{tracks}masks/masks.json",
    log:
        "<logs>/{scene}/{tracks}regions.log",
    benchmark:
        "<benchmarks>/{scene}/{tracks}regions.tsv"
    wildcard_constraints:
        tracks=plan.known(plan.other_tracks),
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=plan.settings("regions"),
        code=plan.code("regions"),
    script:
        "../workflow_scripts/regions.py"
