"""The eval.json of a method, whole and without each thing, into ablation.json, ablation.csv and a table."""

from drivesplat.workflow.job import job
from drivesplat.evaluation.ablation import ablation, markdown, write_csv
from drivesplat.evaluation.scene_metrics import read_evaluations
from drivesplat.io.storage import write_json
from drivesplat.settings.ablation import AblationJob

with job(snakemake) as current:
    evals = read_evaluations(current.input.evals)
    provenance = current.provenance(*(record["provenance"] for record in evals.values()))
    compared = ablation(evals, current.settings(AblationJob))
    write_csv(current.output.table, compared)
    write_json(current.output.record, {**compared, "provenance": provenance})
    print(markdown(compared), flush=True)
