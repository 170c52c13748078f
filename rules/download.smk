# The download of nuScenes mini, for users who accept its terms.
#
# REQUIRED INPUTS: none; accept_nuscenes_terms in the config, network, about 11 GB of disk while it is unpacked.
# OUTPUTS: the dataset at the dataroot of the config's dataset of version v1.0-mini. None is declared: Snakemake would
# delete it before the rule runs again, and rules that read the tables would download them unasked. There is no
# benchmark either: Snakemake counts it as output, and would not run the rule again for an emptied dataroot.


rule download_nuscenes_mini:
    """
    Downloads nuScenes mini unless it is present, resumes an interrupted download, verifies and unpacks the archive.
    Runs only when it is requested by name.
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
