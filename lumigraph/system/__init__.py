"""The process: memory, threads, signals, child processes, terminal, progress bars."""
