"""Methods side by side: what is trained on what, each cell in a process of its own, and what came of it.

OUTPUT/
├── settings.json   what all cells share
├── runs/           a run's folder for each cell, and its log beside
├── results.json    all figures
├── results.md      the same as tables, with the charts
└── *.svg, *.png    charts, and one held-out view as every method shows it
"""
