"""Tests of the sinks of the viewer."""

import os
import subprocess
import sys


def test_viewer_file_causes_no_warning_of_rerun(tmp_path):
    """Rerun writes its warnings to the file descriptor of standard error, not to ``sys.stderr``."""
    code = (
        "import sys; from monitor.publishing.rerun import sinks; import rerun as rr\n"
        "s = rr.RecordingStream('a'); s.set_sinks(rr.FileSink(sys.argv[1], write_footer=False)); s.disconnect()"
    )
    environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.rrd")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
