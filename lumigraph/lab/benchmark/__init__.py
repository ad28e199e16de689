"""Methods side by side: cells that train in processes of their own, tables, charts.

OUTPUT/
├── settings.json   what all cells share
├── runs/           a run's folder for each cell, and its log beside
├── results.json    all figures
├── results.md      the same as tables, with the charts
└── *.svg, *.png    charts, and one held-out view as every method shows it
"""
