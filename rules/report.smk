# The gap between static and moving pixels, across scenes and methods.
#
# REQUIRED INPUTS: <results>/{scene}/metrics.json of all scenes; of those measured, where the report alone is asked for.
# OUTPUTS: <results>/gap_report.csv and gap_report.json, and a table on the console.


rule gap_report:
    """
    A row per scene and method. Results of other settings or code than the config's are left out and named.
    """
    input:
        metrics=expand("<results>/{scene}/metrics.json", scene=plan.report_scenes(asked.targets)),
    output:
        table=report(
            "<results>/gap_report.csv",
            caption="../report/gap_report.rst",
            category="Across scenes",
            labels={"what": "the gap, by scene and method"},
        ),
        report="<results>/gap_report.json",
    log:
        "<logs>/gap_report.log",
    benchmark:
        "<benchmarks>/gap_report.tsv"
    conda:
        "../envs/drivesplat.yaml"
    params:
        expected=plan.expected_stages(),
        code=plan.code("gap_report"),
    script:
        "../workflow_scripts/gap_report.py"
