"""Metrics as a table: one line for each figure."""


class CsvLogger:
    """metrics.csv in the run: step, name, value."""

    def begin(self, run, options):
        self.file = open(run.folder / "metrics.csv", "a", encoding="utf-8")

    def scalars(self, step, values):
        self.file.writelines(f"{step},{name},{value}\n" for name, value in values.items())

    def picture(self, step, name, rgb):
        pass

    def end(self):
        self.file.close()
