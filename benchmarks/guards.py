"""Takes guards of the server out, one at a time, and sees that a test fails: what no test notices is not guarded.

    python benchmarks/guards.py [NAME ...]

The program is copied beside, changed there, and tested there. Exit code 1: a guard went unnoticed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
_COPIED = ("benchmarks", "clients", "potserver", "schemas", "tests", "pyproject.toml", "docs", "docker")
_TIMEOUT_S = 600.0


class Guard(NamedTuple):
    """A line that guards something, what stands there without it, and which tests must notice."""

    name: str
    file: str
    line: str
    without: str
    tests: str
    chosen: str = ""  # pytest's -k


GUARDS = (
    Guard(
        "a journal that ends too early",
        "potserver/storage/agreement.py",
        "    if journal.last < largest:\n",
        "    if False:\n",
        "tests/storage/test_store_faults.py",
        "flips or cut_off",
    ),
    Guard(
        "a snapshot that is too old",
        "potserver/storage/agreement.py",
        "    if edition < mark.edition:\n",
        "    if False:\n",
        "tests/storage/test_store_faults.py",
        "snapshot",
    ),
    Guard(
        "files that are gone",
        "potserver/storage/files.py",
        "            if known is None or look is None or look[:2] != known:\n",
        "            if False:\n",
        "tests/storage/test_store_faults.py",
        "files_that_are_gone",
    ),
    Guard(
        "files that somebody cut",
        "potserver/storage/files.py",
        "            if n_bytes < self._sizes[path]:\n",
        "            if False:\n",
        "tests/storage/test_store_faults.py",
        "somebody_cut",
    ),
    Guard(
        "a log without its file",
        "potserver/storage/agreement.py",
        "    if gone and (has_begun or any(log_of(folder / name).exists() for name in gone)):\n",
        "    if gone and has_begun:\n",
        "tests/storage/test_store_faults.py",
        "whose_file_is_gone",
    ),
    Guard(
        "a link in the place of a file",
        "potserver/storage/files.py",
        "    if not stat.S_ISREG(mode):\n",
        "    if False:\n",
        "tests/storage/test_store_faults.py",
        "link",
    ),
    Guard(
        "clouds that come twice",
        "potserver/domain/order.py",
        "        if seq < wanted:\n",
        "        if False:\n",
        "tests/domain/test_order.py",
    ),
    Guard(
        "shared memory",
        "clients/potclient/zenoh_config.py",
        "    SHM_ENABLED: False,\n",
        "    SHM_ENABLED: True,\n",
        "tests/adapters/test_session.py",
    ),
    Guard(
        "turns between askers",
        "potserver/adapters/query_pool.py",
        "                    asker = min(ready, key=lambda a: a.used_s)\n",
        "                    asker = ready[0]\n",
        "tests/adapters/test_query_pool.py",
    ),
    Guard(
        "askers that are gone",
        "potserver/adapters/query_pool.py",
        "        for job in waiting:\n            job.abandon()\n",
        "",
        "tests/adapters/test_query_pool.py",
    ),
    Guard(
        "askers that ask too often",
        "potserver/adapters/query_pool.py",
        "            self._rates.check(job.asker)\n",
        "",
        "tests/integration/test_server_questions.py",
        "too_often",
    ),
    Guard(
        "many values in a message",
        "potserver/codec/base.py",
        "    if n_bytes > limit:\n",
        "    if False:\n",
        "tests/codec/test_base.py",
    ),
    Guard(
        "a full map",
        "potserver/adapters/writer.py",
        "        if n_bytes >= self._bounds.max_map_bytes:\n",
        "        if False:\n",
        "tests/integration/test_server_store.py",
        "full_map",
    ),
    Guard(
        "a full share of a map",
        "potserver/adapters/writer.py",
        "        if share >= self._bounds.max_robot_bytes:\n",
        "        if False:\n",
        "tests/integration/test_pages.py",
        "share",
    ),
    Guard(
        "pages that cannot be read",
        "potserver/domain/mapped.py",
        "        _install()\n",
        "",
        "tests/domain/test_pages.py",
        "read_back",
    ),
    Guard(
        "questions about a map that cannot be read",
        "potserver/adapters/answers.py",
        "                    self._served.check_readable()\n",
        "                    pass\n",
        "tests/integration/test_pages.py",
        "read_back",
    ),
    Guard(
        "other bits on pages",
        "potserver/domain/pages.py",
        "        return zlib.crc32(self.data) == self.digest\n",
        "        return True\n",
        "tests/domain/test_pages.py",
        "flips or damaged",
    ),
    Guard(
        "signals that another thread gets",
        "potserver/commands/serve.py",
        "signal.set_wakeup_fd(stop._write_end, warn_on_full_buffer=False)",
        "-1",
        "tests/commands/test_server_cli.py",
        "another_thread",
    ),
    Guard(
        "poisoned atoms",
        "potserver/atoms/admission.py",
        "        if not nll <= _MAX_OWN_NLL:\n",
        "        if False:\n",
        "tests/atoms/test_admission.py",
        "poison",
    ),
    Guard(
        "atoms that speak of places without points",
        "potserver/atoms/admission.py",
        "    if not (most <= _MAX_UNVOUCHED and rms <= _MAX_RMS_UNVOUCHED):\n",
        "    if False:\n",
        "tests/atoms/test_admission.py",
        "no_points",
    ),
    Guard(
        "a file that the disk cannot read",
        "potserver/storage/sqlite.py",
        "        _check_readable(path)\n",
        "",
        "tests/storage/test_store_faults.py",
        "cannot_read",
    ),
    Guard(
        "secrets in tracebacks",
        "potserver/log.py",
        "                _hide_secrets,  # in the tracebacks too\n",
        "",
        "tests/commands/test_server_cli.py",
        "secret",
    ),
    Guard(
        "a large dictionary",
        "potserver/mapping/matching.py",
        "        if n <= most:\n",
        "        if True:\n",
        "tests/mapping/test_matching.py",
        "dictionary",
    ),
    Guard(
        "secrets in texts",
        "schemas/potschemas/redaction.py",
        "    return _ASSIGNED.search(text) is not None\n",
        "    return False\n",
        "tests/schemas/test_redaction.py",
    ),
    Guard(
        "keys that moved",
        "potserver/adapters/queryable.py",
        "        if op in _MOVED:\n",
        "        if False:\n",
        "tests/integration/test_server_inputs.py",
        "moved",
    ),
    Guard(
        "threads inside Zenoh at the end",
        "clients/potclient/link.py",
        "            self._calls_changed.wait_for(lambda: not self.n_calls, _JOIN_S)\n",
        "            pass\n",
        "tests/integration/test_client_life.py",
        "inside_zenoh",
    ),
)


def is_noticed(guard: Guard) -> bool:
    """Whether its tests fail in a copy of the program without it."""
    to = ROOT / "out" / "guards" / "copy"  # always there, so that what was compiled is found again
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir(parents=True)
    for name in _COPIED:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
        copy(ROOT / name, to / name)
    file = to / guard.file
    file.write_text(file.read_text().replace(guard.line, guard.without))
    packages = os.pathsep.join(map(str, (to, to / "clients", to / "schemas")))
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        "--timeout",
        "120",
        guard.tests,
    ]
    try:
        run = subprocess.run(
            [*command, *(["-k", guard.chosen] if guard.chosen else [])],
            cwd=to,
            env=os.environ | {"PYTHONPATH": packages, "NUMBA_CACHE_DIR": str(to.parent / "numba")},
            capture_output=True,
            timeout=_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        return True
    if run.returncode == 5:
        raise ValueError(f"{guard.name}: no test is chosen")
    return run.returncode != 0


def main() -> int:
    """Run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="of guards, or parts of them [all]")
    options = parser.parse_args()
    chosen = [g for g in GUARDS if not options.names or any(name in g.name for name in options.names)]
    unnoticed = 0
    for guard in chosen:
        noticed = is_noticed(guard)
        unnoticed += not noticed
        print(f"{guard.name}: {'noticed' if noticed else 'NOT NOTICED'}", flush=True)
    print(f"{len(chosen) - unnoticed} of {len(chosen)} were noticed")
    return 1 if unnoticed else 0


if __name__ == "__main__":
    sys.exit(main())
