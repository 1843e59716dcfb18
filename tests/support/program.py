"""The program as a user runs it."""

import pytest

from monitor.cli import main


def exit_status(*arguments: object) -> int:
    """Run ``imu-monitor`` with these arguments in this process and return its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["imu-monitor", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    return int(end.value.code or 0)
