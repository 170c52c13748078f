# The closed loop: policies that drive in a trained drive.
#
# REQUIRED INPUTS: <results>/{scene}/{method}/checkpoint.npz and eval.json of any method, scene.json and parser.npz; scans.npz
# of methods that render LiDAR; the runs file, named by `runs`, is read while planning, like the scene's edits file: a changed run
# reruns, its neighbours in the file do not. The assets that the run's edit inserts.
# OUTPUTS: <results>/{scene}/{method}/runs/{run}.json and {run}.mp4; on request {run}/drive/ with drive.json.


rule run:
    """
    Lets a policy drive in a trained drive: its scores, and a film of what its camera saw.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        parser=plan.of_tracks("parser.npz"),
        # what its held-out images say of others
        evaluation="<results>/{scene}/{method}/eval.json",
        scans=plan.training_input("scans"),
        inserts=plan.inserts,
    output:
        record="<results>/{scene}/{method}/runs/{run}.json",
        film=report(
            "<results>/{scene}/{method}/runs/{run}.mp4",
            caption="../report/run.rst",
            category="Scene {scene}",
            subcategory="{method}",
            labels={"what": "run: {run}"},
        ),
    log:
        "<logs>/{scene}/{method}/run_{run}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/run_{run}.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("run"),
        code=plan.code("run"),
    script:
        "../workflow_scripts/run.py"


rule run_folder:
    """
    Drives a run again and writes it as a drive folder: what the sensors of the policy measured at every step, the path
    of the ego vehicle, and the boxes of all objects.
    """
    input:
        checkpoint="<results>/{scene}/{method}/checkpoint.npz",
        scene=plan.scene,
        parser=plan.of_tracks("parser.npz"),
        # what its held-out images say of others
        evaluation="<results>/{scene}/{method}/eval.json",
        scans=plan.training_input("scans"),
        inserts=plan.inserts,
        # what was driven before
        record="<results>/{scene}/{method}/runs/{run}.json",
    output:
        drive="<results>/{scene}/{method}/runs/{run}/drive/drive.json",
    log:
        "<logs>/{scene}/{method}/run_folder_{run}.log",
    benchmark:
        "<benchmarks>/{scene}/{method}/run_folder_{run}.tsv"
    conda:
        "../envs/drivesplat.yaml"
    threads: plan.threads(on_gpu=4)
    resources:
        gpu=plan.gpus,
        device=plan.device,
        mem_mb=8000,
        runtime=60,
    params:
        settings=plan.settings("run_folder"),
        code=plan.code("run_folder"),
    script:
        "../workflow_scripts/run_folder.py"
