"""Sphinx: pages in Markdown, the reference from docstrings. `make docs` builds it, strictly."""

from pygments.lexers.special import TextLexer

from casest import __version__

project = "casest"
release = version = __version__
copyright = "the casest authors, MIT licence"

extensions = ["myst_parser", "sphinx.ext.autodoc"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["out"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
add_module_names = False
toc_object_entries = False
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "casest"
html_copy_source = False
html_show_sphinx = False


def setup(app):
    """Blocks of data are shown as they are; there is no lexer for them."""
    app.add_lexer("csv", TextLexer)
