import pytest

from lare_rl.util.findings import Finding, format_for_reader, render

CATALOGUE = {
    "learned": "Learned in {n_seeds:count seed}: {return_:number}{where}. Next: `lare-rl {command}`.",
    "where": " at {steps:,}, in <{names}>",
}
LEARNED = Finding("learned", {"n_seeds": 1, "return_": 2.5, "where": None, "command": "<x_y>"})


def test_render_nested():
    where = Finding("where", {"steps": (1000, 2000), "names": ("a", "b")})
    finding = Finding("learned", {**LEARNED.values, "where": where})
    text = render(finding, CATALOGUE)
    assert text == "Learned in 1 seed: 2.5 at 1,000, 2,000, in <a, b>. Next: `lare-rl <x_y>`."


def test_render_styles():
    finding = Finding("where", {"steps": 1, "names": "`a_b` c_d"})
    assert render(finding, CATALOGUE, "html") == " at 1, in &lt;<code>a_b</code> c_d&gt;"


def test_render_incomplete():
    with pytest.raises(KeyError, match="names"):
        render(Finding("where", {"steps": 1}), CATALOGUE)
    with pytest.raises(KeyError, match="other"):
        render(Finding("other"), CATALOGUE)


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [
        (12345.6, "number", "12,346"),
        (-12.345, "number", "-12.3"),
        (float("nan"), "number", "nan"),
        (1, "count episode", "1 episode"),
        (1000, "count episode", "1,000 episodes"),
        (0.991, "r2", "0.991"),
        (0.0123, "error", "0.01"),
        (0.0001, "error", "less than 0.001"),
        (9.6, "error", "10"),
        (float("nan"), "error", "nan"),
        (0.5, ".0%", "50%"),
        (0.4, "seconds", "0 s"),
        (61.0, "seconds", "2 min"),
        (5399.0, "seconds", "90 min"),
        (7920.0, "seconds", "2.2 h"),
    ],
)
def test_format_for_reader(value, spec, text):
    assert format_for_reader(value, spec) == text
