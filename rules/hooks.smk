# Hooks of a run: the check of its jobs (in a dry run, too), the estimate and the lock at its start, costs and
# figures at its end, where jobs failed a partial report.
#
# REQUIRED INPUTS: none.
# OUTPUTS: <results>/costs.csv and costs.json, of all jobs that have run; where jobs failed, the partial report. No rule
# declares the costs: they change with every job, and no rule reads them.


rule costs:
    """
    Runs no job; every run writes costs.csv and costs.json at its end, and this target prints them.
    """
    input:
        [],


rule estimate:
    """
    Prints the time and disk that the other targets (by default all) would take, and runs nothing.
    """
    input:
        [] if wanted else rules.all.input,


if workflow.is_main_process:
    snakemake_logger.addFilter(when_planned(workflow, plan.check_jobs))


onstart:
    if workflow.is_main_process:
        if run_costs.print_estimate():
            sys.exit(0)
        try:
            plan.hold_results()
        except DriveSplatError as error:
            sys.exit(f"drivesplat: {error}")
        run_costs.begin()


onsuccess:
    if workflow.is_main_process:
        from drivesplat.report.run_figures import print_run_figures

        run_costs.end()
        outputs = (str(file) for job in workflow.dag.jobs for file in job.output)
        print_run_figures(outputs, Path(plan.config.results_dir))


onerror:
    if workflow.is_main_process:
        if across_scenes.wanted:
            from drivesplat.report.partial import write_partial_report

            write_partial_report(plan)
        run_costs.end()
        run_costs.name_failed_blocks()
