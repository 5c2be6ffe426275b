"""The page: what lies where, and which answer belongs to what. Needs Gradio."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gradio as gr

from ..file_rectifiers import BlindRectifier
from ..pictures import PICTURE_SUFFIXES
from .answers import ESTIMATED, IDEAL, LENS_FILE, LINES, MASK, Answers
from .controls import EXAMPLE_LENS, FRAMINGS, LENS, WIDE_FRAMINGS, decimals

Event = Callable[..., Any]

# The theme's own semi-bold is all but empty; its bold is whole. Both are served from here.
_FONT = gr.themes.LocalFont("Source Sans Pro", weights=(400, 700))
THEME = gr.themes.Default(primary_hue="teal", neutral_hue="slate", font=[_FONT, "system-ui", "sans-serif"])


STYLE = Path(__file__).with_name("page.css")

_PARAMETERS = {"fx": "fx, px", "fy": "fy, px", "cx": "cx, px", "cy": "cy, px"} | {f"k{i}": f"k{i}" for i in range(1, 5)}
_IDEALS = [(name.capitalize(), name) for name in ("equidistant", "equisolid", "stereographic", "orthographic")]
_PROJECTIONS = [("Perspective", "pinhole"), ("Cylindrical", "cylindrical"), ("Equirectangular", "equirectangular")]
_PROJECTIONS += [("Stereographic", "stereographic"), ("Panini", "panini")]
_FORMATS = [("As the photo", ""), ("PNG", ".png"), ("JPEG", ".jpg")]


class Page:
    """The page, as `blocks`.

    Args:
        first: the picture to begin with; None for the example.
        blind: estimates lenses.
        folder: where files to be downloaded are put.
    """

    def __init__(self, first: Path | None, blind: BlindRectifier, folder: Path) -> None:
        self.answers = Answers(first, blind, folder)
        # What is shown lies in files that the browser fetches; an hour later it has.
        self.blocks = gr.Blocks(title="fisheyerec", analytics_enabled=False, fill_width=True, delete_cache=(600, 3600))
        with self.blocks:
            self.photo, self.lens = gr.State(), gr.State()
            gr.HTML("<h1>fisheyerec</h1><span>Make fisheye pictures straight</span>", elem_id="heading")
            with gr.Row(elem_id="workplace"):
                with gr.Column(scale=5, min_width=320, elem_id="result"):
                    self._lay_out_result()
                    self._lay_out_downloads()
                with gr.Column(scale=3, min_width=320, elem_id="controls"):
                    self._lay_out_lens(ESTIMATED if first else IDEAL)
                    self._lay_out_view()
            self._connect_lens()
            self._connect_view()
            self._connect_downloads()

    def _lay_out_result(self) -> None:
        self.comparison = gr.ImageSlider(
            show_label=False,
            format="jpeg",
            buttons=["fullscreen"],
            interactive=False,
            max_height=900,
            elem_id="comparison",
        )
        self.told = gr.HTML(elem_id="told")
        self.marks = gr.CheckboxGroup([LINES, MASK], value=[MASK], show_label=False, container=False, elem_id="marks")

    def _lay_out_lens(self, source: str) -> None:
        suffixes = sorted(PICTURE_SUFFIXES)
        self.photo_file = gr.File(label="Fisheye photo", file_types=suffixes, height=130, elem_id="photo")
        with gr.Group():
            self.source = gr.Radio([ESTIMATED, LENS_FILE, IDEAL], value=source, label="Lens", elem_id="source")
            with gr.Row(visible=source == ESTIMATED, elem_id="estimating") as self.estimating:
                self.again = gr.Button("Estimate from this photo", size="md", min_width=180, elem_id="estimate")
                self.note = gr.HTML(elem_id="note")
            self.lens_file = gr.File(label="Lens file", height=130, visible=False, elem_id="lens-file")
            with gr.Row(visible=source == IDEAL) as self.ideal:
                projection, fov_deg = EXAMPLE_LENS
                self.ideal_projection = gr.Dropdown(_IDEALS, value=projection, label="Projection", min_width=120)
                self.ideal_fov = _slider(20, 220, fov_deg, step=1, label="Field of view, °")
        with gr.Accordion("Lens parameters"), gr.Row(elem_classes="pairs"):
            self.params = [
                _slider(step=10.0 ** -decimals(name), label=label, elem_id=name) for name, label in _PARAMETERS.items()
            ]

    def _lay_out_view(self) -> None:
        with gr.Accordion("View"), gr.Row(elem_classes="pairs"):
            self.projection = gr.Dropdown(
                _PROJECTIONS, value="pinhole", label="Projection", min_width=140, elem_id="projection"
            )
            self.framing = gr.Dropdown(
                FRAMINGS, value="edge_matched", label="Framing", min_width=140, elem_id="framing"
            )
            self.fov = _slider(10, 170, 100, step=1, label="Field of view, °", visible=False, elem_id="fov")
            self.balance = _slider(0, 1, 0.5, step=0.01, label="Balance", visible=False, elem_id="balance")
            self.wide_framing = gr.Dropdown(
                WIDE_FRAMINGS, value=LENS, label="Framing", min_width=140, visible=False, elem_id="wide-framing"
            )
            self.wide_fov = _slider(10, 360, 180, step=1, label="Field of view, °", visible=False, elem_id="wide-fov")
            self.turns = [
                _slider(-limit, limit, 0, step=0.1, label=f"{name.capitalize()}, °", elem_id=name)
                for name, limit in (("pan", 90), ("tilt", 90), ("roll", 180))
            ]

    def _lay_out_downloads(self) -> None:
        with gr.Group(elem_id="download"):
            self.format = gr.Radio(_FORMATS, value="", label="Download")
            with gr.Row():
                self.take_picture = gr.Button("Picture", variant="primary", min_width=120, elem_id="take-picture")
                self.take_camera = gr.Button("Lens file", min_width=120, elem_id="take-camera")
        self.picture_link = gr.DownloadButton(visible="hidden", elem_id="picture-link")
        self.camera_link = gr.DownloadButton(visible="hidden", elem_id="camera-link")

    def _connect_lens(self) -> None:
        answers, choice = self.answers, [self.estimating, self.lens_file, self.ideal]
        begun = _answer(self.blocks.load, answers.begin, [], [self.photo])
        opened = _answer(self.photo_file.upload, answers.open_photo, [self.photo_file], [self.photo])
        chosen = _answer(opened.success, answers.source_of_new_photo, [self.lens_file], [self.source, *choice])
        turned = _answer(self.source.input, answers.show_source, [self.source], choice)
        changes = [begun.success, chosen.success, turned.success, self.again.click, self.lens_file.upload]
        changes += [self.ideal_projection.input, self.ideal_fov.input]
        lens = [self.photo, self.source, self.lens_file, self.ideal_projection, self.ideal_fov]
        for change in changes:
            found = _answer(
                change, answers.find_lens, lens, [self.lens, *self.params, self.note], progress_on=self.comparison
            )
            self._show_after(found.success)

    def _connect_view(self) -> None:
        kinds = [self.projection, self.framing, self.wide_framing]
        framed = [self.framing, self.fov, self.balance, self.wide_framing, self.wide_fov]
        for kind in kinds:
            self._show_after(_answer(kind.input, self.answers.show_view, kinds, framed).success)
        sliders = [*self.params, self.fov, self.balance, self.wide_fov, *self.turns]
        for moved in (self.marks.input, *(slider.input for slider in sliders)):
            self._show_after(moved)

    def _show_after(self, event: Event) -> None:
        _answer(event, self.answers.show, [*self._shown, self.marks], [self.comparison, self.told])

    def _connect_downloads(self) -> None:
        written = _answer(
            self.take_picture.click, self.answers.rectified_file, [*self._shown, self.format], [self.picture_link]
        )
        _answer(written.success, None, [], [], js="() => document.getElementById('picture-link').click()")
        written = _answer(
            self.take_camera.click, self.answers.camera_file, [self.photo, self.lens, *self.params], [self.camera_link]
        )
        _answer(written.success, None, [], [], js="() => document.getElementById('camera-link').click()")

    @property
    def _shown(self) -> list[Any]:
        """What decides how the result looks."""
        framed = [self.framing, self.fov, self.balance, self.wide_framing, self.wide_fov]
        return [self.photo, self.lens, *self.params, self.projection, *framed, *self.turns]


def _slider(*reach: float, label: str, step: float, **options: Any) -> gr.Slider:
    return gr.Slider(*reach, label=label, step=step, buttons=[], min_width=140, **options)


def _answer(
    event: Event,
    answer: Callable[..., Any] | None,
    inputs: list[Any],
    outputs: list[Any],
    *,
    js: str | None = None,
    progress_on: Any = None,
) -> Any:
    """Connect an answer to an event; of those that come while it is at work the last one counts."""
    return event(
        answer,
        inputs,
        outputs,
        js=js,
        show_progress="hidden" if progress_on is None else "minimal",
        show_progress_on=progress_on,
        trigger_mode="always_last",
        api_visibility="private",
    )
