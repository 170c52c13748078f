"""ghosts.html, and where the published fixes of ghosts are named."""

import base64

from helpers import REPOSITORY
from helpers.archives import addresses

from drivesplat.evaluation.published_fixes import PUBLISHED_FIXES
from drivesplat.report.files import render_ghosts_page


def test_the_page_has_the_document_without_links_to_other_documents():
    page = render_ghosts_page()
    assert all(address.startswith("data:") for address in addresses(page)) and ".md)" not in page
    assert "<h2>Related methods</h2>" in page and page.count("<table>") == 4
    assert all(f"<td>{fix.method}</td><td>{fix.adds}</td>" in page for fix in PUBLISHED_FIXES)


def test_pictures_are_part_of_the_page(tmp_path):
    document, picture = tmp_path / "ghosts.md", REPOSITORY / "docs/images/ghosts.webp"
    (tmp_path / "images").mkdir()
    (tmp_path / "images/a.webp").write_bytes(picture.read_bytes())
    document.write_text("![two cars](images/a.webp)\n\n![lost](images/b.webp)\n")
    page = render_ghosts_page(document)
    assert page.count("<img") == 1 and base64.b64encode(picture.read_bytes()).decode() in page
    assert 'alt="two cars"' in page and "lost" not in page


def test_links_and_markup_of_the_document_or_without_it_the_fixes(tmp_path):
    document = tmp_path / "ghosts.md"
    page = render_ghosts_page(document)
    assert "docs/ghosts.md" in page and all(fix.adds in page for fix in PUBLISHED_FIXES)
    document.write_text("[`street`](street.md#a) and [paper](https://x.org/1)\n\n| a | b |\n|---|---|\n| 1 | 2 |\n")
    page = render_ghosts_page(document)
    assert "<code>street</code> and" in page and "street.md" not in page and "<td>2</td>" in page
    assert 'href="https://x.org/1"' in page


def test_the_document_and_the_caption_of_the_ghost_panel_name_the_same_fixes():
    document = (REPOSITORY / "docs/ghosts.md").read_text()
    caption = (REPOSITORY / "report/ghost_panel.rst").read_text()
    for fix in PUBLISHED_FIXES:
        assert f"**{fix.method}** [" in document and f"- **{fix.method}**: {fix.adds}\n" in caption
