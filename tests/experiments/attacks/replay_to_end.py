"""Replay the file on the command line to its end. If it is damaged, print one line of error and exit with status 2."""

import logging
import sys

from drivers.errors import ConfigError, LinkEnded, LinkUnavailable
from drivers.links.replay_link import Settings, build


def main() -> None:
    """Read until the link ends."""
    logging.getLogger("can").addHandler(logging.NullHandler())  # as in the daemon, which writes these lines to its log
    link = build(Settings(path=sys.argv[1], speed="max"))
    try:
        link.open()
        while True:
            link.wait_for_chunks_or_timeout(1.0)
    except (ConfigError, LinkUnavailable, LinkEnded) as error:
        print(error, file=sys.stderr)
        sys.exit(0 if str(error).endswith("the end of the file.") else 2)


if __name__ == "__main__":
    main()
