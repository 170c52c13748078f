"""scripts/check_texts.py, a part of `make lint`: it finds each kind of fault in a small repository."""

from pathlib import Path

from scripts import check_texts

FILES = {
    "tests/forbidden_terms.txt": "# Terms\nname sheet*\nphrase held to\nname two_*\nsheet\n",
    "README.md": "# A title, here\n[here](#a-title-here) [absent](docs/absent.md) [far](https://x.y) [no](#titles)\n",
    "docs/troubleshooting.md": "### `no usable GPU: torch …; …`\n### `no usable abacus`\n### `masks.json`\n"
    "`train.cap_max` `train.no_such` `train: {cap_max: 500}` `train: {cap_max: none}` `images.json`\n",
    "drivesplat/pages.py": 'sheets = f"no usable GPU: torch {1}; so on"\n\n\ndef f(x):\n    """Held\n    to it."""\n'
    "    x.two_sided = 1  # not  held\n",
}  # fmt: skip
FOUND = [
    "tests/forbidden_terms.txt: 'sheet' is neither a name nor a phrase",
    "drivesplat/pages.py: the name sheets",
    "drivesplat/pages.py: the name two_sided",
    "drivesplat/pages.py: …Held to it.…",
    "README.md: the link #titles leads nowhere",
    "README.md: the link docs/absent.md leads nowhere",
    "docs/troubleshooting.md: no message of the code is `no usable abacus`",
    "docs/troubleshooting.md: train: {cap_max: none}: ",
    "docs/troubleshooting.md: there is no setting train.no_such",
]


def test_each_kind_of_fault_is_found_and_nothing_else(tmp_path: Path, capsys):
    for name, content in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content, encoding="utf-8")
    assert check_texts.main(tmp_path) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(FOUND) and all(line.startswith(begun) for line, begun in zip(lines, FOUND, strict=True))
