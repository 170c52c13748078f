"""The names of a scene's films, pictures and links, into a page that shows them."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.report.film_page import write_film_page
from drivesplat.settings.report import FilmPageJob

with job(snakemake, check_inputs=False) as current:
    write_film_page(Path(current.output.page), current.settings(FilmPageJob))
