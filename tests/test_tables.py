import importlib.util
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def test_reference_tables_are_up_to_date():
    spec = importlib.util.spec_from_file_location("reference_page_maker", DOCS / "tables.py")
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    pages = maker.make_pages()
    assert len(pages) > 7
    assert maker.outdated(pages) == [], "run: python docs/tables.py"
