"""What `potserver serve` looks at before it serves."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from potserver.commands.serve import check_compiled
from potserver.errors import SettingsError


def test_compiled_numerics_lie_where_nobody_else_may_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_compiled(None)
    folder = tmp_path / "cache" / "numba"
    check_compiled(str(folder))
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o755)
    check_compiled(str(folder))
    folder.chmod(0o777)
    with pytest.raises(SettingsError, match=r"NUMBA_CACHE_DIR is .*chmod 700"):
        check_compiled(str(folder))
    folder.chmod(0o700)
    owner = folder.stat().st_uid
    os.chown(folder, 12345, -1) if os.getuid() == 0 else monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.raises(SettingsError, match="others than this user"):
        check_compiled(str(folder))
