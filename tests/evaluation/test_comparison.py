"""Figures over several random seeds: means without nulls, differences paired by seed, and their format."""

from drivesplat.evaluation.comparison import (
    PSNRS,
    compare_runs,
    format_difference,
    format_mean,
    format_spread,
    markdown_table,
    measured_groups,
    paired_difference,
    summarize,
    values_at,
)


def test_differences_are_paired_by_seed():
    """Effects common to all trainings of a seed cancel: differences vary less than the figures."""
    assert paired_difference([10.0, 20.0, 30.0], [11.0, 21.0, 31.0]) == {
        "mean": -1.0, "standard_error": 0.0, "by_seed": [-1.0] * 3
    }  # fmt: skip
    shuffled = paired_difference([10.0, 20.0, 30.0], [31.0, 11.0, 21.0])
    assert shuffled["mean"] == -1.0 and shuffled["standard_error"] > 5.0


def test_a_single_seed_has_no_standard_error():
    assert paired_difference([1.0], [3.0]) == {"mean": -2.0, "standard_error": None, "by_seed": [-2.0]}
    assert summarize([1.0]) == {"mean": 1.0, "min": 1.0, "max": 1.0, "by_seed": [1.0]}


def test_null_figures_are_left_out_of_means_and_differences():
    assert summarize([None, None]) is None and paired_difference([None, 1.0], [1.0, None]) is None
    assert summarize([0.0, 2.0])["mean"] == 1.0, "0 is not null"
    assert paired_difference([1.0, 4.0], [1.0, 2.0])["mean"] == 1.0
    assert summarize([2.0, None, 4.0]) == {"mean": 3.0, "min": 2.0, "max": 4.0, "by_seed": [2.0, None, 4.0]}
    assert paired_difference([2.0, None, 4.0], [1.0, 1.0, None]) == {
        "mean": 1.0, "standard_error": None, "by_seed": [1.0, None, None]
    }  # fmt: skip


def group(static: float | None, gap: float | None = None) -> dict:
    return {"static": None if static is None else {"psnr": static}, "moving_vehicle": None, "gap_db": gap}


def test_a_missing_run_is_left_out_of_figures_and_differences():
    """The second seed has no result, the third no static pixels in extrapolation."""
    runs = [
        {"interpolation": group(20.0), "extrapolation": group(10.0)},
        None,
        {"interpolation": group(24.0, gap=0.0), "extrapolation": group(None)},
    ]
    reference = [{"interpolation": group(19.0), "extrapolation": group(12.0)}] * 3
    row = compare_runs(runs, reference, PSNRS)
    assert row["interpolation"]["static"] == {"mean": 22.0, "min": 20.0, "max": 24.0, "by_seed": [20.0, None, 24.0]}
    assert row["interpolation"]["difference"]["static"]["by_seed"] == [1.0, None, 5.0]
    assert row["interpolation"]["gap_db"]["by_seed"] == [None, None, 0.0], "0 is not null"
    assert row["extrapolation"]["difference"]["static"] == {
        "mean": -2.0, "standard_error": None, "by_seed": [-2.0, None, None]
    }  # fmt: skip
    assert row["interpolation"]["moving_vehicle"] is None
    assert compare_runs(runs, None, PSNRS)["interpolation"]["difference"] == dict.fromkeys(PSNRS)


def test_a_path_beyond_a_record_gives_null():
    runs = [{"a": {"b": 0.0}}, {"a": None}, {}, None, {"a": {}}]
    assert values_at(runs, "a", "b") == [0.0, None, None, None, None]
    assert values_at([{"gaussians": 5}, None], "gaussians") == [5, None]


def test_a_group_counts_as_measured_if_any_row_has_a_figure():
    runs = [{"interpolation": group(None), "extrapolation": group(psnr)} for psnr in (None, 0)]
    rows = [compare_runs([run], None, PSNRS) for run in runs]
    assert measured_groups(rows, PSNRS) == ["extrapolation"] and measured_groups(rows[:1], PSNRS) == []


def test_figures_are_formatted_with_standard_deviation_and_error():
    found = {"mean": 25.04, "min": 24.0, "max": 26.26}
    assert format_spread(found) == "25.0 (24.0 to 26.3)" and format_spread(found, digits=2) == "25.04 (24.00 to 26.26)"
    assert format_difference({"mean": 0.5, "standard_error": 0.123}) == "+0.50 ± 0.12"
    assert format_difference({"mean": -1.0, "standard_error": None}) == "-1.00"
    assert format_mean({"mean": 1234.4}, "{:,.0f} s") == "1,234 s"
    assert format_spread(None) == format_difference(None) == format_mean(None, "{:.1f}") == "-"
    assert markdown_table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
