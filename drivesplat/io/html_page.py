"""Pages of HTML from Jinja templates that lie beside a package's modules."""

from pathlib import Path
from types import ModuleType
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from drivesplat.io.storage import atomic_write


def filled_page(package: ModuleType, **values: Any) -> str:
    """The page.html of a package, filled in with `values`: escaped text, unless a value is `Markup`.

    The template can use `file(name)`, the text of a file beside it; `value | figure(form)`, a number in a format of
    `str.format`, a dash for None; `value | tojson`, which cannot end the HTML element around it.
    """
    folder = Path(package.__file__).parent
    pages = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    pages.policies["json.dumps_kwargs"] = {"sort_keys": True, "separators": (",", ":"), "allow_nan": False}
    pages.globals["file"] = lambda name: Markup((folder / name).read_text(encoding="utf-8"))
    pages.filters["figure"] = lambda value, form: "–" if value is None else form.format(value)
    return pages.get_template("page.html").render(values)


def write_page(path: Path, page: str) -> None:
    """Writes a page to `path`, whose folder is made. Raises ResultError if that fails."""
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as file:
        file.write(page.encode())
