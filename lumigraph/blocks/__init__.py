"""A scene too large for one field: where its blocks are, what each learns, and who computes them.

layout     where blocks are, and which photographs each learns from
crossings  where streets meet, by where photographs were taken
drawing    the plan seen from above
planning   a run's folder with all its tasks, before anything is learnt
task       one block: a plain function over its folder, which may be called again at any time
conduct    all blocks, in this process or on others;  on_ray  the others
watch      how far all of them are
finishing  one light for all of them; one cloud, where they are splats
update     one block again, from other photographs
"""
