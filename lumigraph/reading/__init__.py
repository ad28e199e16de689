"""Reading edition: fifteen short programs, one idea each, in NumPy and PyTorch alone.

Read them in this order: camera, volume, nerf, hashgrid, factors, surface, deform, pose, bake; microsplat, splats;
stereo, tsdf; lightfield, fourier. `python -m lumigraph.reading.NAME` runs one and writes `reading-NAME.png`.
"""
