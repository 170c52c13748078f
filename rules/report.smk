# The gap between static and dynamic pixels, across scenes and methods; and the page of a scene's films.
#
# REQUIRED INPUTS: <results>/{scene}/metrics.json of all scenes, with their pictures and films; where the report is the
# only target, of the measured scenes, with the files that exist.
# OUTPUTS: <results>/{scene}/index.html; <results>/gap_report.html, gap_report.json and gap_report.csv, ghosts.html, .report/gap_report.html (the page
# for Snakemake's report), and a table on the console.


rule film_page:
    """
    Writes a page with all films of a scene and what each shows in words, its pictures, and links to figures and viewers.
    """
    output:
        page="<results>/{scene}/index.html",
    log:
        "<logs>/{scene}/film_page.log",
    benchmark:
        "<benchmarks>/{scene}/film_page.tsv"
    conda:
        "../envs/drivesplat.yaml"
    params:
        # no inputs: the page names files and reads none, so that it asks for no film and a new film does not change it
        settings=film_pages.settings,
        code=plan.code("film_page"),
    script:
        "../workflow_scripts/film_page.py"


rule gap_report:
    """
    Writes a table with a row per scene and method, means with confidence intervals, a plot of the gap, and an HTML page.
    Results of other settings or code are left out and named.
    """
    input:
        metrics=across_scenes.metrics,
        pictures=across_scenes.pictures,
        runs=across_scenes.runs,
    output:
        page="<results>/gap_report.html",
        # the same with the links of the archive that --report writes
        archived=report(
            "<results>/.report/gap_report.html",
            caption="../report/gap_report.rst",
            category="Across scenes",
            labels={"what": "the gap, by scene and method: the page"},
        ),
        ghosts=report(
            "<results>/ghosts.html",
            caption="../report/ghosts.rst",
            category="Across scenes",
            labels={"what": "ghosts, and published fixes"},
        ),
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
    # after films and edits, whose costs it lists
    priority: -1
    conda:
        "../envs/drivesplat.yaml"
    params:
        settings=across_scenes.settings,
        # no inputs: the page names these files and reads none, so that a new film does not change it
        links=across_scenes.links,
        code=plan.code("gap_report"),
    script:
        "../workflow_scripts/gap_report.py"
