"""Files of other programs that are not read here: what each is, and the way from it to one that is."""

from __future__ import annotations

from pathlib import Path

from .atomic import explained, is_file

SPLATS = "convert it to .ply with the program that wrote it, SuperSplat or splat-transform"
MESH = "export it as .glb or .obj, for instance from Blender"
SPHERE = "export its film as equirectangular from the camera's program, then: lumigraph capture FILM --camera spherical"
COLMAP_EXPORT = "export the cameras as COLMAP text beside the photographs"
FILES = {  # by suffix: what a file is, the way out
    ".zip .tar .gz .tgz .7z .rar .xz .zst": ("an archive", "unpack it, and name the folder or the file in it"),
    ".ksplat .splatv .lcc .rad .spx .gsplat .psht .ssproj .sog4 .xgrids": ("a file of Gaussians", SPLATS),
    ".fbx .dae .3ds .3mf .blend .abc .wrl .x3d .step .stp .iges .max .c4d .usd .usda .usdc .usdz .drc .ifc .skp .lwo "
    ".vtk .vtp .b3dm .mesh": ("a mesh", MESH),
    ".ckpt .pt .pth .safetensors .npz .npy .pkl .h5 .hdf5": (
        "a checkpoint or a table of numbers",
        "export a .ply or .glb from it",
    ),
    ".insv .360 .insp": ("a film or picture of two fisheye circles", SPHERE),
    ".r3d": ("a recording of Record3D", "export it there as RGBD (zip), unpack it, and name the folder"),
    ".bag .mcap .db3 .svo .svo2 .oni .klg": (
        "a recording of a depth camera",
        "write its frames as color/0.png, depth/0.png (millimetres) and intrinsic/intrinsic_color.txt, and track them",
    ),
    ".vdb": ("a grid of voxels", "train on photographs of it"),
}
METASHAPE = "in Metashape, File > Export > Export Cameras as COLMAP, and name its folder"
POSES = {  # by name in a folder: a word of its first kilobytes, whose poses, the way out
    "*.xml": ("<document", "Metashape", METASHAPE),
    "*.xmp": ("xcr:", "RealityScan (RealityCapture)", "there, Export > Registration as COLMAP, and name its folder"),
    "*.csv": ("#name", "RealityScan (RealityCapture)", "there, Export > Registration as COLMAP, and name its folder"),
    "*.out": ("Bundle", "Bundler", COLMAP_EXPORT),
    "*.nvm": ("NVM_V3", "VisualSFM", "convert them by COLMAP's model_converter, or " + COLMAP_EXPORT),
    "*.sfm": ("", "Meshroom", "add its node ConvertSfMFormat with COLMAP's output, and name that folder"),
    "sfm_data.json": ("", "OpenMVG", "run openMVG_main_openMVG2Colmap, and name its folder"),
    "reconstruction.json": ("", "OpenSfM (ODM, WebODM)", "run `opensfm export_colmap`, and name its folder"),
    "sparse/0/images.*": (
        "",
        "COLMAP without its cameras",
        "copy cameras, images and points3D there, all .bin or .txt",
    ),
    "*.db": ("SQLite", "COLMAP, without a model", "run COLMAP's mapper, which writes sparse/0"),
    "meta_data.json": ("", "SDFStudio", "write transforms.json as nerfstudio does, from its camtoworld and intrinsics"),
    "*.json": ('"transform_matrix"', "instant-ngp or nerfstudio under another name", "name the file transforms.json"),
    "pose/*.txt": ("", "NSVF without pictures or a camera", "put those in rgb/, and f cx cy into intrinsics.txt"),
    "cameras*.npz": ("", "IDR or NeuS", "write transforms.json as nerfstudio does, from its world_mat and scale_mat"),
    "cams/*_cam.txt": ("extrinsic", "MVSNet", COLMAP_EXPORT),
    "cameras.json": ("", "3D Gaussian splatting's output", "name the folder that it learnt from, or its .ply"),
}
PROBED_BYTES = 4096


def is_pose_file(path: Path) -> bool:
    """True for a name that a file of poses of another program may have."""
    return any(path.match(pattern) for pattern in POSES)


def about_file(path: Path) -> str | None:
    """Sentence on a file of another program, with the way out; None for any other suffix."""
    found = next((about for suffixes, about in FILES.items() if path.suffix.lower() in suffixes.split()), None)
    return None if found is None else f"{path} is {found[0]}, which is not read here; {found[1]}"


def about_poses(folder: Path) -> str | None:
    """Sentence on poses of another program in a folder or in its images, with the way out; None without any."""
    for pattern, (word, program, remedy) in POSES.items():
        for file in (x for place in (folder, folder / "images") for x in place.glob(pattern) if is_file(x)):
            with explained(file), open(file, "rb") as opened:
                if word.encode() in opened.read(PROBED_BYTES):
                    return (
                        f"{file} looks like the poses of {program}, which are not read here; {remedy}, or find poses "
                        f"anew: lumigraph capture {folder}"
                    )
            break
    return None
