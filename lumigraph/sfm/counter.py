"""Write the number of rows of a table in COLMAP's database to standard output, at intervals.

A process of its own, until its standard input ends. Python and COLMAP each bring an SQLite; two of them in one process
break each other's locks on one file, and its shared memory is then truncated while the other reads it.
"""

import os
import sqlite3
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

POLL_SECONDS = 0.2  # between reads of the database


def watch(database: str, table: str, since: str) -> None:
    """Print the number of rows, for ever. since: "begin" for rows added from now on, "ever" for all"""
    where, before = f"{Path(database).absolute().as_uri()}?mode=ro", None if since == "begin" else 0
    while True:
        try:
            with closing(sqlite3.connect(where, uri=True)) as connection:
                count = connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
            before = count if before is None else before
            os.write(sys.stdout.fileno(), f"{count - before}\n".encode())  # a line is written whole or not at all
        except sqlite3.OperationalError:  # COLMAP is writing just now, or has not begun to
            pass
        time.sleep(POLL_SECONDS)


def end_with_input() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    threading.Thread(target=end_with_input, daemon=True).start()
    watch(*sys.argv[1:])
