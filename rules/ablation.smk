# Ablation: the contribution of each component of a method, from trainings without it.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/eval.json of the method and of all its variants, with every seed: methods
# that the section `ablation` of the config names, trained and measured by the rules `train` and `evaluate`.
# OUTPUTS: <results>/{scene}/ablation.json and ablation.csv, and a table on the console. No other rule asks for them.


rule ablation:
    """
    Compares a method with variants that lack one of its parts, losses or degrees of freedom, over several random seeds.
    """
    input:
        evals=expand("<results>/{{scene}}/{method}/eval.json", method=plan.config.ablated),
    output:
        table=report(
            "<results>/{scene}/ablation.csv",
            caption="../report/ablation.rst",
            category="Scene {scene}",
            subcategory="figures",
            labels={"what": "contribution of each component"},
        ),
        record="<results>/{scene}/ablation.json",
    log:
        "<logs>/{scene}/ablation.log",
    benchmark:
        "<benchmarks>/{scene}/ablation.tsv"
    conda:
        "../envs/drivesplat.yaml"
    params:
        settings=plan.settings("ablation"),
        code=plan.code("ablation"),
    script:
        "../workflow_scripts/ablation.py"
