"""Benchmark of methods: cells that train in separate processes, tables, charts.

OUTPUT/
├── settings.json   common settings of all cells
├── runs/           a run's folder for each cell, and its log beside
├── results.json    all figures
├── results.md      the same as tables, with the charts
└── *.svg, *.png    charts, and one held-out view rendered by every method
"""
