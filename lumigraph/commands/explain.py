"""`lumigraph explain`: pictures of a paper's equations on your own data."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from ..errors import LumigraphError
from ..files.options import DeviceOption, Overwrite, PhotographsOption, RunOption, SeedOption, Set, needed, option
from ..files.ranges import Count, Downscale, Seconds, Steps, between
from .common import choose_device, scene_name, show

Place = Annotated[int, between(0, 1_000_000)]  # along one side of a picture
OCTAVES = tuple(2.0**octave for octave in range(8))  # scales of encodings, 1 to 128


@dataclass(frozen=True)
class ExplainActivation:
    """Fit a sharp edge with a coarse grid in three orders: activation before, within and after interpolation.

    One picture shows the result of each, with its PSNR.
    """

    output: Annotated[Path, option("FILE.png")] = Path("explained/activation.png")
    """File of the picture."""
    overwrite: Overwrite = False
    cells: Annotated[int, between(2, 128), option("N")] = 10
    """Cells of the grid along each axis; more reduce the differences."""
    steps: Annotated[Steps, option("N")] = 1500
    """Training steps for each order."""

    def run(self) -> int:
        from ..files import claim
        from ..lab.explain.activation import draw, fits
        from ..system.progress import counting

        claim(self.output, "figure", self.overwrite)
        with counting("Fitting an edge in three orders"):
            found = fits(self.cells, self.steps)
        draw(self.output, found, self.cells)
        show({fit.name: f"{fit.psnr:.2f} dB" for fit in found} | {"picture": str(self.output)})
        return 0


@dataclass(frozen=True)
class ExplainEncodings:
    """Fit a network to a picture with each encoding of its pixels, over a range of scales.

    Half of the pixels are held out. One page, index.html, shows their PSNR against scale, the spectrum of the neural
    tangent kernel, and the networks' pictures.
    """

    picture: Annotated[Positional[Path], needed("PICTURE")]
    """An image file."""
    output: Annotated[Path | None, option("FOLDER", "explained/PICTURE-encodings")] = None
    """Folder of the page."""
    overwrite: Overwrite = False
    steps: Annotated[Steps, option("N")] = 500
    """Training steps for each network."""
    scales: Annotated[tuple[Annotated[float, between(1e-6, 1e6)], ...], option("S S ...")] = OCTAVES
    """Scales to compare, in cycles across the picture: deviation of Gaussian, highest of positional frequencies."""
    downscale: Annotated[Downscale | None, option("N", "to about 512 pixels")] = None
    """Reduce the picture by this whole number; a larger one is faster."""
    seed: SeedOption = 0
    device: DeviceOption = "auto"

    def run(self) -> int:
        if len(set(self.scales)) < 2:
            raise LumigraphError("A curve over scales needs two or more of them; for example --scales 1 10 100")
        from dataclasses import replace

        from ..lab.explain.encodings import compare
        from ..lab.explain.encodings_page import claim_page, write_page
        from ..methods.fourier_features import FourierFeatures
        from ..opening import open_scene
        from ..readers import single_image
        from ..system.progress import counting

        if not single_image.recognises(self.picture.expanduser()):
            raise LumigraphError(f"{self.picture} is no image file; name one picture, as in photograph.png")
        folder = self.output or Path("explained") / f"{scene_name(str(self.picture))}-encodings"
        claim_page(folder, self.overwrite, [self.picture.expanduser()])
        device = choose_device(self.device)
        scene = open_scene(self.picture, self.downscale)
        config = replace(FourierFeatures.preset(device), seed=self.seed)
        comparison = compare(scene, tuple(sorted(set(self.scales))), self.steps, device, config)
        with counting("Drawing the page"):
            write_page(folder, comparison)
        show({fit.name: f"{fit.held_out:.2f} dB" for fit in comparison.leading} | {"page": str(folder / "index.html")})
        return 0


@dataclass(frozen=True)
class ExplainFitting:
    """Fit a sphere to a mesh or to photographs of an object by gradients, in large steps and in plain ones.

    One picture shows the target and the surfaces after some steps, one chart the errors; their numbers are beside them
    as JSON. A mesh is photographed by the rasteriser, and has a chamfer distance too.
    """

    data: Annotated[Positional[str], needed("MESH_OR_PHOTOS")]
    """A mesh file, or photographs with alpha, as `lumigraph train` takes them."""
    output: Annotated[Path | None, option("FOLDER", "explained/DATA-fitting")] = None
    """Folder of fitting.png, fitting.svg and fitting.json."""
    overwrite: Overwrite = False
    steps: Annotated[Annotated[int, between(2, 100_000)], option("N")] = 200
    """Steps of either fit, of four photographs each; more come closer to the target."""
    seed: SeedOption = 0

    def run(self) -> int:
        from ..datasets.scene import Scene
        from ..datasets.shapes import Shapes
        from ..files import claim
        from ..lab.explain.fitting import compare, draw
        from ..opening import open_dataset

        name = scene_name(self.data)
        folder = self.output or Path("explained") / f"{name}-fitting"
        for file in ("fitting.png", "fitting.svg", "fitting.json"):
            claim(folder / file, "figure", self.overwrite)
        data = open_dataset(self.data)
        if not isinstance(data, Scene | Shapes):
            raise LumigraphError(f"{self.data} holds {data.kind}; name one mesh, or photographs of one object")
        target, fits = compare(data, self.steps, self.seed)
        draw(folder, name, target, fits)
        rows = {fit.name: f"{fit.errors[-1]:.2g} squared error" for fit in fits}
        rows |= {f"{fit.name}, chamfer": f"{fit.chamfer[-1]:.2f} % of the diagonal" for fit in fits if fit.chamfer}
        show(rows | {"files": str(folder)})
        return 0


@dataclass(frozen=True)
class ExplainLightField:
    """Render a row of cameras: its epipolar-plane image, spectrum, and cameras needed against layers of depth.

    Views are interpolated between fewer and fewer cameras, with depth in fewer and fewer layers. A chart shows the
    cameras that were needed beside the bound of Chai et al. (2000).
    """

    run_folder: RunOption
    output: Annotated[Path | None, option("FOLDER", "RUN/lightfield")] = None
    """Folder of lightfield.png, lightfield.svg and lightfield.json."""
    overwrite: Overwrite = False
    view: Annotated[str, option("NAME_OR_NUMBER")] = "0"
    """Photograph of the split test whose camera is in the middle of the row."""
    span: Annotated[Annotated[float, between(0.001, 2)], option("SHARE")] = 0.2
    """Length of the row, in distances of the focal plane; longer needs more cameras."""
    size: Annotated[Annotated[int, between(32, 1024)], option("PIXELS")] = 192
    """Longer side of each picture; larger needs more cameras, and takes longer."""
    settings: Set = ()
    device: DeviceOption = "auto"

    def run(self) -> int:
        from ..export.light_field import focal_distance
        from ..files import claim
        from ..lab.explain.light_field import draw, measure, seen_along
        from ..run import Run
        from ..run.opened import controlled

        run = Run(self.run_folder)
        folder = self.output or run.folder / "lightfield"
        for file in ("lightfield.png", "lightfield.svg", "lightfield.json"):
            claim(folder / file, "figure", self.overwrite)
        name, camera = run.find_view("test", self.view)
        method = controlled(run, run.method(choose_device(self.device)), self.settings)
        camera = camera.resized(self.size / int(camera.size.max())).to(method.device)
        focus = focal_distance(method, camera)
        line = seen_along(method, camera, self.span * focus, focus)
        found = measure(line)
        about = draw(folder, f"{run.method_name}, {name}", line, found, int(camera.size[0, 1]) // 2)
        rows = {
            f"{n} layer{'s' * (n > 1)}": f"{'no number' if need is None else f'{need:.1f}'} of cameras, "
            f"bound {bound:.1f}"
            for n, need, bound in zip(found.layers, about["needed"], about["bound"], strict=True)
        }
        show({"quality": f"{found.target:.1f} dB", **rows, "files": str(folder)})
        return 0


@dataclass(frozen=True)
class ExplainRay:
    """Draw density, transmittance, weights, samples and accumulated colour along the ray of a pixel.

    One figure, which opens in a browser; its numbers are beside it as JSON. It includes the photograph's own colour if
    the photographs are available.
    """

    run_folder: RunOption
    pixel: Annotated[tuple[Place, Place] | None, option("X Y", "the middle of the picture")] = None
    """Column and row of the pixel, from 0 0 at the upper left."""
    view: Annotated[str, option("NAME_OR_NUMBER")] = "0"
    """Photograph of the split: its name, or its number from 0."""
    split: Literal["test", "val", "train"] = "test"
    """Split of the photograph."""
    output: Annotated[Path | None, option("FILE.svg", "RUN/rays/VIEW-X-Y.svg")] = None
    """File of the figure."""
    overwrite: Overwrite = False
    scene: PhotographsOption = None
    settings: Set = ()
    device: DeviceOption = "auto"

    def run(self) -> int:
        if self.output and self.output.suffix != ".svg":
            raise LumigraphError(f"{self.output} has no ending of a figure; give --output a name ending in .svg")
        from ..evaluation.views import file_name
        from ..figures.charts import standalone
        from ..files import claim, write_bytes, write_json
        from ..lab.explain.ray import along_ray
        from ..lab.explain.ray_figure import ray_figure
        from ..run import Run
        from ..run.opened import controlled
        from ..system.progress import counting

        run = Run(self.run_folder)
        name, camera = run.find_view(self.split, self.view)
        x, y = pixel = self.pixel or tuple((camera.size[0] // 2).tolist())
        output = self.output or run.folder / "rays" / f"{file_name(name)}-{x}-{y}.svg"
        for file in (output, output.with_suffix(".json")):
            claim(file, "figure", self.overwrite)
        method = controlled(run, run.method(choose_device(self.device)), self.settings)
        camera = method.refined(camera)
        with counting("Sampling the ray"):
            sight = along_ray(method, camera, pixel)
        scene = run.photographs(self.scene, "The figure does without the photograph")
        if scene is not None:
            sight = sight.beside(scene.photograph(scene.names.index(name)).before(run.frame.background))
        title = f"{run.method_name}: pixel ({x}, {y}) of {name}"
        write_bytes(output, standalone(ray_figure(sight, title)), "figure")
        about: dict[str, Any] = {"run": str(run.folder), "method": run.method_name, "view": name, "split": self.split}
        about |= {"controls": method.settings} if method.settings else {}
        write_json(output.with_suffix(".json"), about | sight.to_json(), "figure")
        show(sight.rows() | {"files": f"{output}, {output.with_suffix('.json')}"})
        return 0


@dataclass(frozen=True)
class ExplainScattering:
    """Fit fields of emission and absorption to fog that scatters the light of a lamp, and move the lamp.

    Pictures beside the tracer's, PSNR against the lamp's movement for each degree of view-dependent colour, and the
    fitted colour against the phase function.
    """

    output: Annotated[Path, option("FOLDER")] = Path("explained/scattering")
    """Folder of scattering.png, lamps.svg, phase.svg and scattering.json."""
    overwrite: Overwrite = False
    anisotropy: Annotated[Annotated[float, between(0, 0.95)], option("G")] = 0.6
    """Asymmetry of the phase function: 0 scatters evenly, a larger one more forward."""
    steps: Annotated[Steps, option("N")] = 500
    """Training steps of each field; more fit more closely."""
    size: Annotated[Annotated[int, between(8, 256)], option("PIXELS")] = 64
    """Side of each picture; larger is finer and slower."""
    seed: SeedOption = 0

    def run(self) -> int:
        from ..files import claim
        from ..lab.explain.scattering import LAMPS, draw, measure

        for file in ("scattering.png", "lamps.svg", "phase.svg", "scattering.json"):
            claim(self.output / file, "figure", self.overwrite)
        found, pictures = measure(self.anisotropy, self.steps, self.size, self.seed)
        draw(self.output, found, pictures)
        rows = {
            f"degree {fit.degree}": f"{fit.moved[0]:.1f} dB; {fit.moved[LAMPS.index(45)]:.1f} dB with the lamp moved "
            f"45 degrees; {fit.inside:.1f} dB from within"
            for fit in found.fits
        }
        show(rows | {"files": str(self.output)})
        return 0


@dataclass(frozen=True)
class ExplainTemplate:
    """Move a trained run into other structures and continue there: the template of fast radiance fields.

    One picture shows a held-out view as trained, moved, continued, and by each method trained from nothing for as long;
    a chart shows PSNR by seconds of training, and their numbers are beside them as JSON.
    """

    run_folder: RunOption
    output: Annotated[Path | None, option("FOLDER", "RUN/template")] = None
    """New folder of template.png, template.svg, template.json and the runs."""
    into: Annotated[tuple[str, ...], option("METHOD ...")] = ("plenoctrees", "gaussian-splatting")
    """Methods to move into; `lumigraph convert --list` says which can be."""
    seconds: Annotated[Seconds, option("S")] = 30.0
    """Training in each of them after the move."""
    alone: bool = True
    """Also train each of them from nothing, for as long as the run and the move together."""
    views: Annotated[Count, option("N")] = 4
    """Held-out views to compare at most."""
    scene: PhotographsOption = None

    def run(self) -> int:
        from .. import methods
        from ..lab.explain.template import draw, shown_photograph, stages_of
        from ..run import Run, check_new

        run = Run(self.run_folder)
        folder = self.output or run.folder / "template"
        check_new(folder)
        into = tuple(dict.fromkeys(map(methods.check, self.into)))
        scene = run.scene(self.scene)
        found = stages_of(run, scene, into, self.seconds, self.views, folder, self.alone)
        first = scene.photograph(shown_photograph(scene)).before(scene.frame.background)
        draw(folder, f"{run.title}: train, move, continue", first, found)
        show({f"{x.method}, {x.stage}": str(x) for x in found} | {"files": str(folder)})
        return 0


What = (
    Annotated[ExplainActivation, subcommand("activation")]
    | Annotated[ExplainEncodings, subcommand("encodings")]
    | Annotated[ExplainFitting, subcommand("fitting")]
    | Annotated[ExplainLightField, subcommand("lightfield")]
    | Annotated[ExplainRay, subcommand("ray")]
    | Annotated[ExplainScattering, subcommand("scattering")]
    | Annotated[ExplainTemplate, subcommand("template")]
)


@dataclass(frozen=True)
class Explain:
    """Draw the equations of a paper on your own data: a page, its pictures, and the figures behind them."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
