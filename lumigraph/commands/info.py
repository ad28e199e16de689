"""`lumigraph info`: contents of a run, a folder of photographs, a mesh, a splat file or a composition."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..files.options import ReaderOption, needed, option
from ..files.ranges import Downscale
from ..system.console import console

TREE_WIDTH = 4096  # letters; a tree cuts its lines where the console ends, and folders have long names


@dataclass(frozen=True)
class Info:
    """Show the contents of a run, scene, mesh, splat file or composition."""

    what: Annotated[Positional[str], needed("RUN_OR_SCENE")]
    """Folder of a run, of photographs or of meshes, a picture, a mesh, procedural:NAME, a splat file, a composition."""
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce a scene's photographs by this whole number before reading."""
    reader: ReaderOption = None

    def run(self) -> int:
        from ..datasets.scene import Scene
        from ..exchange import holds_points, is_moving, is_splat_file, read_gaussians, read_moving, snerg
        from ..large import BlockRun
        from ..large.opening import SAMPLE, without_sample
        from ..opening import folder_of, open_dataset, read_capture
        from ..run import is_block_run
        from ..sfm.doctor import findings
        from . import info_tree

        if self.what.startswith(SAMPLE):
            return replace(self, what=str(without_sample(self.what))).run()
        if is_block_run(Path(self.what)):
            tree = info_tree.blocks_tree(BlockRun(self.what))
        elif (Path(self.what) / "config.json").exists():
            from ..run import Run

            tree = info_tree.run_tree(Run(self.what))
        elif is_moving(self.what):
            tree = info_tree.moving_tree(self.what, read_moving(self.what))
        elif is_splat_file(self.what) and not holds_points(self.what):
            tree = info_tree.cloud_tree(self.what, read_gaussians(self.what))
        elif self.what.lower().endswith(".json") and folder_of(Path(self.what)).is_file():
            from ..large import open_any
            from ..run.composition import Canonicalised

            opened = open_any(self.what)
            made = info_tree.canonical_tree if isinstance(opened, Canonicalised) else info_tree.composition_tree
            tree = made(opened)
        elif snerg.recognises(Path(self.what)):
            from ..run.files import SnergFolder

            tree = info_tree.atlas_tree(SnergFolder(self.what))
        else:
            options: dict[str, Any] = {"downscale": self.downscale, "reader": self.reader}
            data = open_dataset(self.what, **options)
            tree = info_tree.dataset_tree(data)
            if isinstance(data, Scene) and Path(data.source).expanduser().is_dir():
                upright = data.frame.to_source.rotation.T.double().numpy()
                info_tree.add_findings(tree, findings(read_capture(data.source, self.reader), None, upright))
        console(width=TREE_WIDTH, soft_wrap=True).print(tree)
        return 0
