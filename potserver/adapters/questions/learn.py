"""`ctl/learn`: the dictionary grows by what a map's scans have taught. No cloud waits for it."""

from __future__ import annotations

from potschemas import messages
from potschemas.messages import ABSENT
from potserver.adapters.questions.question import Asked, Question, Single, the_part
from potserver.errors import BadMessageError, PotserverError


def _plan(asked: Asked, request: messages.ControlRequest) -> Single:
    name = request.name
    if name is ABSENT or request.robot is not ABSENT or request.T_map_saved is not ABSENT:
        raise BadMessageError("learn needs the name of the place, and takes nothing else")
    return Single(lambda: _learn(asked, str(name)), is_short=False)


def _learn(asked: Asked, name: str) -> messages.ControlReply:
    served = asked.served
    try:
        done = served.atoms.learn(
            name, served.mapper.learned_from, max_range_m=served.mapper.settings.max_range_m
        )
    except PotserverError as error:
        served.health.count(f"atoms.refused.{error.reason or error.code}")
        raise
    served.health.count("atoms.learned")
    served.audit.changed("control.learn", asked.asker, **done._asdict())
    kept = "saved" if done.persisted else "until the server restarts"
    message = (
        f"{name} learned from {done.n_scans} scans, {kept}: NLL of beams that were held out {done.nll_before:.3f} ->"
        f" {done.nll:.3f}"
    )
    return messages.ControlReply(verb="learn", map_revision=served.mapper.state.map_revision, message=message)


LEARN = Question(
    op="learn",
    query=messages.ControlRequest,
    plan=_plan,
    each=the_part,
    is_quick=False,
    reads_tiles=False,
)
