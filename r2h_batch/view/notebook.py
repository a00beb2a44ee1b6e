"""`show(scores[i])`: a judged handover in three dimensions inside a notebook, as a page that stays
in the notebook's file."""

from dataclasses import asdict, replace
from html import escape
from types import SimpleNamespace

from r2h_batch.checks import kind, whole
from r2h_batch.export.drawing import Stage
from r2h_batch.export.replay import difference, judge_again, names_of
from r2h_batch.export.stored import StoredTrial, stored_trial
from r2h_batch.runs.rows import detail_rows, score_rows
from r2h_batch.types import Predictions, Scores
from r2h_batch.view.page import page_of

__all__ = ["Shown", "show"]


class Shown:
    """A page for a notebook (`_repr_html_`); `html` is the page itself, `trial` what it shows."""

    def __init__(self, trial: StoredTrial, height: int) -> None:
        self.trial, self.height = trial, height
        self.html = page_of([Stage(trial)])

    def __repr__(self) -> str:
        return f"Shown(trial {self.trial.row['trial_id']}, {self.trial.row['outcome']}, {len(self.html) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe style="{style}" srcdoc="{escape(self.html, quote=True)}"></iframe>'


def show(scores: Scores, *, height: int = 640) -> Shown:
    """One row of scores in three dimensions: `show(scores[3])`. The row is planned and moved again,
    to the same bits.

    ValueError where there is more than one row, where nobody kept what was asked, or where the
    answer was no pose.
    """
    kind(Scores, "what Evaluator.score returns")("scores", scores)
    height = whole(100, 10_000, " of pixels")("height", height)
    asked = scores.asked
    if len(scores) != 1 or scores.outcome.ndim != 1:
        raise ValueError(
            f"show takes one row, given are {tuple(scores.outcome.shape)}; say show(scores[0])"
        )
    if asked is None:
        raise ValueError(
            "these scores do not know what was asked (captured, compiled, joined or loaded); score again"
        )
    evaluator = asked.evaluator
    trial = asked.trials.named(evaluator.scene.objects)
    answer = Predictions(trial.trial_id, asked.T_obj_ee, asked.T_world_ee, method="shown")
    if bool((scores.opening_m != scores.opening_m).any()):
        raise ValueError(
            "this row was not judged (its answer was no pose): there is nothing to show"
        )
    again, names = judge_again(evaluator, trial, answer), names_of(evaluator)
    row = (
        score_rows(trial, scores, names).to_pylist()[0]
        | detail_rows(trial, scores, names).to_pylist()[0]
    )
    execute = evaluator.config.execute
    header = {
        "configuration": asdict(evaluator.config), "protocol": "",
        "motion": {"sample_s": execute.step_s * execute.record_steps},
    }  # fmt: skip
    place = SimpleNamespace(
        objects=evaluator.scene.objects,
        hand_set=evaluator.scene.hands.set,
        workplace=evaluator.config.workplace,
    )
    moved = bool(
        scores.path_len[0] > 0
    )  # of stages="pose" nothing but the margins that need no path is the same
    note = difference(row, again.row) if moved else ""
    told = stored_trial(header, "shown", again.row, again.path, trial, answer, place)
    return Shown(
        replace(told, asked_q=again.asked_q, asked_clearance_m=again.asked_clearance_m, note=note),
        height,
    )
