"""Sphinx configuration: pages in Markdown, tutorials executed at build, warnings are errors (`make docs`)."""

import os
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

# the tutorials run `raytwin` as a reader does, one thread each
os.environ["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["RAYTWIN_FLEXRAY"] = str(HERE.parent / "data" / "real" / "flexray")

project = "raytwin"
author = "The raytwin developers"
copyright = author
release = installed_version("raytwin")
version = release

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # formulas without the internet
    "sphinx_copybutton",
    "sphinx_design",
    "raytwin_pages",
]
exclude_patterns = ["_build", "_ext", "jupyter_execute", "**/.ipynb_checkpoints"]
suppress_warnings = ["config.cache"]  # functions in the configuration cannot be pickled

# Markdown and notebooks
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_output_stderr = "remove"  # progress bars

# the API, from its docstrings
autosummary_generate = True
autodoc_typehints = "none"  # the signature says them; docstrings say units and shapes
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_param = True
napoleon_custom_sections = ["Source", "Checked against", "Fields"]
default_role = "literal"
templates_path = ["_templates"]
add_module_names = False
python_use_unqualified_type_names = True

highlight_language = "text"  # of blocks that do not say theirs

# HTML
html_theme = "pydata_sphinx_theme"
html_title = f"raytwin {release}"
html_static_path = ["_static"]
html_css_files = ["raytwin.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 9,
    "show_nav_level": 1,
    "navigation_with_keys": False,
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
alone = ("index", "start", "physics", "generated/effects_gallery", "generated/limits", "generated/validation")
html_sidebars = {name: [] for name in alone}  # pages without others below them
copybutton_exclude = ".linenos, .gp, .go"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
