# Drives as MCAP files of ROS 2 messages, on request; they need the package rosbags.
#
# REQUIRED INPUTS: drive/drive.json in a folder of <results>/{scene}/{method}/, of edits/{edit}, trajectories/{trajectory}
# or runs/{run}; scans/scans.json beside it of methods that render LiDAR, not of runs, whose drive folders have sweeps.
# OUTPUTS: drive.mcap in that folder; <results>/{scene}/{method}/drive.mcap, of the trajectory of the recorded path.


rule drive_mcap:
    """
    Writes a rendered drive as an MCAP file of ROS 2 messages: images, point clouds, transforms, odometry and boxes.
    """
    input:
        drive=plan.drive_of_mcap,
        scans=plan.scans_of_mcap,
    output:
        mcap="<results>/{scene}/{method}/{at}drive.mcap",
    log:
        "<logs>/{scene}/{method}/{at}drive_mcap.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/{at}drive_mcap.tsv"
    wildcard_constraints:
        at="((edits|trajectories|runs)/[^/]+/)?",
    conda:
        "../envs/drivesplat.yaml"
    resources:
        mem_mb=4000,
        runtime=15,
    params:
        settings=plan.settings("drive_mcap"),
        code=plan.code("drive_mcap"),
    script:
        "../workflow_scripts/drive_mcap.py"
