"""Goals of the project and claims of the paper, compared with the measurements."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from active6d_tools.results.tables import MEASURES, interval, number, percent, table

#: Results of one object by the name of the job in :mod:`active6d_tools.results.page`.
Measured = Mapping[str, dict[str, Any]]
DEFAULT, PAPERS = "view-attention", "attention"
#: Jobs that evaluate the default policy with few moves.
_FEW_MOVES = {3: "evaluate_three", 4: "evaluate_four", 5: "evaluate"}
#: What an interval over starts and scenes does not hold: how much other seeds of the trainings differ.
_ONE_SEED = "with one training of each"
BASELINES = ("single-view", "random", "max-distance", "unidirectional", "entropy", "lowest-score")


@dataclass(frozen=True)
class Verdict:
    """Whether a goal is met for one object, and the figures; ``caveat`` limits a yes."""

    met: bool
    figures: str
    caveat: str = ""


def goals_table(
    goals: Mapping[str, Callable[[Measured], Verdict]], measured: Mapping[str, Measured], word: str = "met"
) -> str:
    """Goals as rows, objects as columns; "not measured" if a result or its policy is missing."""
    rows = []
    for text, judge in goals.items():
        cells = [text]
        for own in measured.values():
            try:
                verdict = judge(own)
            except KeyError:
                cells.append("not measured")
                continue
            answer = f"{word} {verdict.caveat}".strip() if verdict.met else f"**not {word}**"
            cells.append(f"{answer}: {verdict.figures}")
        rows.append(cells)
    return table(["", *measured], rows)


def beats(report: dict[str, Any], name: str, others: Iterable[str], keys: Sequence[str]) -> Verdict:
    """Whether a policy is better than each of the others by each measure, and its smallest lead."""
    against = report["policies"][name]["against"]
    leads = []
    for other in others:
        for key in keys:
            difference, (unit, digits, better) = against[other][key], MEASURES[key]
            # In one scene there is no interval over scenes, so that over episodes ranks the leads.
            ends = sorted(better * end for end in difference["ci95_scenes"] or difference["ci95"])
            lead = number(difference["mean"], digits, True) + unit
            figures = f"{lead} against `{other}` {interval(difference['ci95_scenes'], digits, True)}"
            # In units of the uncertainty, so that rates and millimetres are comparable.
            leads.append(
                (ends[0] / max(ends[1] - ends[0], 1e-12), difference["mean"] * better > 0, difference, figures)
            )
    won = [ahead and difference["excludes_zero"] for _, ahead, difference, _ in leads]
    surely = [ahead and difference["excludes_zero_scenes"] for _, ahead, difference, _ in leads]
    least = min(leads, key=lambda lead: lead[0])[3]
    return Verdict(
        all(won), f"at worst {least}", "over starts, not over scenes" if all(won) and not all(surely) else ""
    )


def _no_farther(own: Measured) -> Verdict:
    policies = own["evaluate"]["policies"]
    metres, randoms = (policies[name]["distance_m"] for name in (DEFAULT, "random"))
    return Verdict(metres <= randoms, f"{metres:.2f} m, `random` {randoms:.2f} m")


def _gap(own: Measured) -> Verdict:
    closed = own["evaluate"]["policies"][DEFAULT]["gap_closed"]
    if closed is None:
        raise KeyError("oracle")
    return Verdict(closed >= 0.6, percent(closed), "and the aim" if closed >= 0.8 else "")


def _few_like_ten(own: Measured) -> Verdict:
    """The least number of moves with which the default policy is as good as Random with ten, on both measures."""
    ten = own["evaluate_ten"]["policies"]["random"]
    rows = {moves: own[job]["policies"][DEFAULT] for moves, job in _FEW_MOVES.items() if job in own}
    good = [
        moves
        for moves, row in rows.items()
        if all(MEASURES[key][2] * (row[key] - ten[key]) >= 0 for key in ("detection_rate", "e_add_mm"))
    ]
    moves = min(good, default=max(rows))
    figures = []
    for key in ("detection_rate", "e_add_mm"):
        unit, digits, _ = MEASURES[key]
        figures.append(f"{number(rows[moves][key], digits)}{unit}, `random` {number(ten[key], digits)}{unit}")
    text = f"with {moves} moves {'; '.join(figures)}"
    return Verdict(bool(good) and moves <= 4, text, "and the aim" if good and moves <= 3 else "")


def _beats_baselines(key: str) -> Callable[[Measured], Verdict]:
    """By the thirty scenes where they are measured."""
    return lambda own: beats(own.get("evaluate_thirty", own["evaluate"]), DEFAULT, BASELINES, [key])


def _attention_learned(own: Measured) -> Verdict:
    lowest = own["attention"]["rows"][1]
    against = lowest["against_first"]
    found, error = against["detection_rate"], against["e_add_mm"]
    figures = f"{number(-found['mean'], 3, True)} found, ADD {percent(-error['mean'] / lowest['e_add_mm'], True)}"
    met = found["mean"] < 0 < error["mean"] and found["excludes_zero"] and error["excludes_zero"]
    return Verdict(met, figures, _ONE_SEED)


def _trained_in_time(own: Measured) -> Verdict:
    minutes = max(row["training_minutes"] for row in own["seeds"]["rows"] if row["policy"] == DEFAULT)
    return Verdict(minutes < 30, f"{minutes:.0f} min")


def _seeds(own: Measured) -> Verdict:
    rows = [row for row in own["seeds"]["rows"] if row["policy"] == DEFAULT]
    rates = [row["detection_rate"] for row in rows]
    figures = f"{number(min(rates), 3)} to {number(max(rates), 3)} found"
    return Verdict(len(rows) >= 3 and any(row["shipped"] and row["best_on_validation"] for row in rows), figures)


def _faster(job: str, key: str, least: float, aim: float, unit: str) -> Callable[[Measured], Verdict]:
    def judge(own: Measured) -> Verdict:
        rate = own[job][key]
        return Verdict(rate >= least, f"{rate:,.0f} {unit}", "and the aim" if rate >= aim else "")

    return judge


def _decides_in_time(own: Measured) -> Verdict:
    milliseconds = own["pipeline"]["policy_ms_p99"]
    return Verdict(milliseconds < 10, f"{milliseconds:.1f} ms", "and the aim" if milliseconds < 5 else "")


GOALS: dict[str, Callable[[Measured], Verdict]] = {
    "The default policy finds more than every baseline": _beats_baselines("detection_rate"),
    "It has a lower ADD than every baseline": _beats_baselines("e_add_mm"),
    "It travels no farther than Random": _no_farther,
    "It closes 60 % of the gap from Random to the greedy oracle (aim: 80 %)": _gap,
    "It reaches with 4 moves what Random reaches with 10 (aim: 3 moves)": _few_like_ten,
    "The paper's policy beats Random and Maximum distance on both measures": lambda own: beats(
        own["evaluate"], PAPERS, ("random", "max-distance"), ["detection_rate", "e_add_mm"]
    ),
    "Its learned attention beats the lowest score (the paper: +3 % found, -9 % ADD)": _attention_learned,
    "Training takes less than 30 minutes": _trained_in_time,
    "Three seeds were trained, and the one that is best on validation scenes ships": _seeds,
    "The environment makes 5,000 steps per second (aim: 50,000)": _faster(
        "environment", "steps_per_second", 5_000, 50_000, "per second"
    ),
    "Verification, fusion and policy run at 25 Hz, as in the paper (aim: 100 Hz)": _faster(
        "pipeline", "hz_total", 25, 100, "Hz"
    ),
    "A decision takes less than 10 ms (99th percentile; aim: 5 ms)": _decides_in_time,
}


def _saturates(own: Measured) -> Verdict:
    found = {row["budget"]: row["detection_rate"] for row in own["steps"]["rows"] if row["variant"] == "random"}
    share = (found[10] - found[0]) / (found[99] - found[0])
    return Verdict(share >= 0.9, f"`random` has {percent(share)} of the gain of all views at T = 10")


def _too_much_closeness(own: Measured) -> Verdict:
    rows = {float(row["variant"]): row for row in own["alpha"]["rows"]}
    metres = {alpha: row["distance_m"] for alpha, row in rows.items()}
    figures = f"{metres[1.0]:.2f} m at alpha 1, {metres[0.5]:.2f} m at .5"
    return Verdict(metres[1.0] > metres[0.5], figures, _ONE_SEED)


def _no_closeness(own: Measured) -> Verdict:
    rows = {float(row["variant"]): row for row in own["alpha"]["rows"]}
    best = min(rows, key=lambda alpha: rows[alpha]["e_add_mm"])
    figures = f"{rows[0.0]['e_add_mm']:.2f} mm at alpha 0, {rows[best]['e_add_mm']:.2f} mm at {best:g}, the best"
    return Verdict(best > 0 and rows[best]["against_first"]["e_add_mm"]["excludes_zero"], figures, _ONE_SEED)


CLAIMS: dict[str, Callable[[Measured], Verdict]] = {
    "The proposed policy has a lower ADD and finds more than Random, Maximum distance and Unidirectional (Table 1)": (
        lambda own: beats(
            own["evaluate"], PAPERS, ("random", "max-distance", "unidirectional"), ["detection_rate", "e_add_mm"]
        )
    ),
    "More views help, but hardly after T = 10 (here: at least 90 % of the gain of all views)": _saturates,
    "Too much weight on closeness increases the distance": _too_much_closeness,
    "Without closeness the policy is harder to learn (here: some alpha has a lower ADD than 0)": _no_closeness,
    "The learned attention beats the lowest score, +3 % found and -9 % ADD": _attention_learned,
}
