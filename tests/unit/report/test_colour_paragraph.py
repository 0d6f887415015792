"""One warning for all lines of a run."""

from mitsim.reconstruct.solver import Status, Verdict
from mitsim.report.reconstruct_run import one_paragraph


def test_lines_share_one_warning_and_no_flag_is_repeated() -> None:
    flag = "The calibration was flagged: a quarter of the frames is left over."
    lost = {name: Status(Verdict.PARTLY_MEASURED, f"Solved, but {n} directions are not measured", "use more patterns",
                         flags=(flag,)) for name, n in (("r", 7), ("g", 9))}  # fmt: skip
    noise = Status(Verdict.SOLVED, "Solved", flags=(flag, "The image is hardly more than noise."))
    (text,) = one_paragraph({**lost, "b": noise, "good": Status(Verdict.SOLVED, "Solved")})
    assert text.startswith("r, g: Solved, but 7 directions are not measured (so r;") and "b: Solved." in text
    assert text.count(flag) == 1 and text.count("hardly more than noise") == 1 and "good" not in text
    assert one_paragraph({"good": Status(Verdict.SOLVED, "Solved")}) == ()
