"""The pictures of README and guide are taken from a page in a real browser, each in its size."""

import pytest
from page_browser import in_a_browser
from PIL import Image

from eval.page_pictures import SHOTS, main

pytestmark = [*in_a_browser, pytest.mark.slow]


def test_every_picture_is_taken_and_shows_more_than_one_color(report, tmp_path):
    main(report.parent, tmp_path)
    for shot in SHOTS:
        with Image.open(tmp_path / f"{shot.name}.png") as image:
            assert len(image.convert("RGB").getcolors(1 << 20) or []) > 20
            if shot.stage_alone:
                assert image.width < shot.window[0] and image.height < shot.window[1]
            else:
                assert image.size == shot.window
