"""The process and its user: memory, threads, signals, child processes, the terminal, progress bars."""
