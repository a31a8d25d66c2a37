"""The page a person looks at: one HTML file, `report_html`; of a large scene with `report_details` beside it.

May import `tracking`, `geometry`, `config`, `progress`, `types`, `whole_file`.
"""

from more2_jax.report.details import report_details
from more2_jax.report.page import report_html, write_report
from more2_jax.report.palette import color, rgb
from more2_jax.report.wording import (
    frame_text,
    leveled_text,
    motion_text,
    noise_text,
    repair_text,
    upright_text,
)

__all__ = [
    "color",
    "frame_text",
    "leveled_text",
    "motion_text",
    "noise_text",
    "repair_text",
    "report_details",
    "report_html",
    "rgb",
    "upright_text",
    "write_report",
]
