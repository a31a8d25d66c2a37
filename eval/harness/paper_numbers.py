"""What the paper prints (paper §4): its own data and weights, quoted beside ours and never to be compared with them.

How its published code really computes some of these figures is said in `CAVEATS`.
"""

from __future__ import annotations

Quoted = dict[str, dict[str, str]]  # figure → method → value as printed

PAPER: dict[str, dict[str, Quoted]] = {
    "end_to_end": {
        "FlyingShape": {
            "MR [%]": {"paper's own": "74.39", "its baseline": "67.32"},
            "MRR [%]": {"paper's own": "62.00", "its baseline": "54.30"},
        },
        "3RScan": {
            "MR [%]": {"paper's own": "49.07", "its baseline": "44.02", "paper's own, Mask3D masks": "40.14"},
            "MRR [%]": {
                "paper's own": "40.74",
                "its baseline": "30.77",
                "paper's own, Mask3D masks": "33.80",
            },
        },
    },
    "matching": {
        "FlyingShape": {
            "instance recall [%]": {"paper's own": "88.75"},
            "scene recall ≥ 50 % [%]": {"paper's own": "97.50"},
            "scene recall ≥ 75 % [%]": {"paper's own": "78.00"},
            "scene recall ≥ 100 % [%]": {"paper's own": "72.00"},
        },
        "3RScan": {
            "instance recall [%]": {"paper's own": "71.77"},
            "instance recall, unmoved [%]": {"paper's own": "60.32"},
            "instance recall, moved [%]": {"paper's own": "87.50"},
            "scene recall ≥ 25 % [%]": {"paper's own": "87.50"},
            "scene recall ≥ 50 % [%]": {"paper's own": "78.41"},
            "scene recall ≥ 75 % [%]": {"paper's own": "50.00"},
        },
    },
    "registration": {
        "FlyingShape": {
            "RR [%]": {
                "paper's own": "83.83",
                "without optimization": "83.00",
                "RPMNet": "23.17",
                "FreeReg": "47.50",
                "GeoTransformer": "77.67",
            },
            "MedRE [°]": {"paper's own": "0.74", "without optimization": "0.86"},
            "RMSE": {"paper's own": "18.47", "without optimization": "20.83"},
            "MedCD": {"paper's own": "0.0168", "without optimization": "0.0171"},
        },
        "3RScan": {
            "RR [%]": {
                "paper's own": "61.11",
                "RPMNet": "9.40",
                "FreeReg": "26.06",
                "GeoTransformer": "51.71",
            },
            "MedRE [°]": {"paper's own": "3.77"},
            "RMSE": {"paper's own": "4.74"},
            "MedCD": {"paper's own": "0.0030"},
        },
    },
    "reconstruction": {
        "FlyingShape": {
            "Chamfer-L1 [10⁻³]": {"paper's own": "6.11", "without optimization": "6.27", "ConvONet": "6.64"},
            "IoU [%]": {"paper's own": "66.73", "without optimization": "49.98", "ConvONet": "36.99"},
            "SDF recall [%]": {"paper's own": "83.33", "without optimization": "78.00", "ConvONet": "80.67"},
        },
        "3RScan": {
            "Chamfer-L1, one way [10⁻³]": {"paper's own": "6.16"},
            "SDF recall [%]": {"paper's own": "64.12"},
        },
    },
}

CAVEATS = {
    "registration": (
        "The published code takes min(RE, |180 − RE|, |90 − RE|) for every object, medians over successes only, and"
        " an RMSE that is √3 smaller than the printed formula."
    ),
    "reconstruction": (
        "The published Chamfer-L1 is a mean of squared distances to mesh vertices, its IoU the share of true"
        " vertices inside the prediction (about 50 % for a perfect surface), and SDF recall counts objects with"
        " more than 70 % of vertices within 0.05."
    ),
    "matching": (
        "The published evaluation assigns greedily by the cosine of F_inv alone, never counts matches of objects"
        " that have no partner, and follows ambiguity chains. The printed 87.50 % of moved objects of 3RScan does"
        " not fit the other two figures and their denominators (81.22 % would)."
    ),
    "end_to_end": "No code was published for MR and MRR; the printed figures fit different denominators.",
}


def quoted(program: str, dataset: str) -> str:
    """A table of what the paper prints for a program, for the data set it resembles; empty if there is nothing."""
    tables = PAPER.get(program, {})
    figures = tables.get("3RScan" if "3RScan" in dataset else "FlyingShape", {})
    if not figures:
        return ""
    methods = list(dict.fromkeys(m for row in figures.values() for m in row))
    lines = [
        "Paper, its data (not comparable):",
        "",
        "| figure | " + " | ".join(methods) + " |",
        "|---" * (len(methods) + 1) + "|",
    ]
    lines += [
        f"| {name} | " + " | ".join(row.get(m, "") for m in methods) + " |" for name, row in figures.items()
    ]
    return "\n".join([*lines, "", CAVEATS.get(program, "")])
