# Getting the data: nuScenes mini, for who accepts its terms.
#
# REQUIRED INPUTS: none; accept_nuscenes_terms in the config, network, about 11 GB of disk while it is unpacked.
# OUTPUTS: the dataset at the dataroot of the config's dataset of version v1.0-mini. None is declared: Snakemake would
# delete it before the rule runs again, and rules that read the tables would fetch them unasked. For the same reason
# there is no benchmark: Snakemake counts it as output, and would take an emptied dataroot for filled.


rule download_nuscenes_mini:
    """
    Fetches nuScenes mini where it is not there yet, goes on where it was cut off, checks and unpacks it. Runs where it
    is asked for by name alone.
    """
    log:
        "<logs>/download_nuscenes_mini.log",
    localrule: True
    conda:
        "../envs/drivesplat.yaml"
    params:
        settings=plan.download_settings,
        code=plan.code("download_nuscenes_mini"),
    script:
        "../workflow_scripts/download_nuscenes_mini.py"
