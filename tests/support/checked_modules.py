"""The modules whose calls are held against their annotations in every test, shapes and dtypes included."""

from places import ROOT

# A name stands for itself and what lies below it.
UNCHECKED = {
    "more2_jax": "the name stands for every module, those below included; its own two functions take names",
    "more2_jax.types": "its records pass through JAX's transformations, which fill them with what is no array",
    "more2_jax.renamed": "takes whatever names older programs ask for; it installs itself before anything else",
}


def library_modules() -> list[str]:
    """Every module of the library, packages as well."""
    files = sorted((ROOT / "more2_jax").rglob("*.py"))
    return [".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for f in files]


def checked_modules() -> list[str]:
    """All of them but for `UNCHECKED`."""
    return [name for name in library_modules() if name not in UNCHECKED]
