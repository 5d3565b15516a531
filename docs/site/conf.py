"""Sphinx: the documentation site; built by ./scripts/docs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel

project = 'MAASI'
author = 'The MAASI developers'
version = release = '0.1.0'
extensions = ['sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'myst_parser', 'sphinx_copybutton']
# Anchors of headings, as on GitHub.
myst_heading_anchors = 4
highlight_language = 'text'
html_theme = 'furo'
html_title = project
html_show_copyright = False
html_copy_source = False
html_static_path = html_css_files = ['site.css']
# Pages rank above entries of the API.
html_search_scorer = str(Path(__file__).with_name('scorer.js'))
# They would be fetched page by page, which a browser refuses to a page from a file.
html_show_search_summary = False
# Backticks in docstrings name code, as in Markdown.
default_role = 'code'

# Classes of one name in two packages: no link is certain, and none is needed.
suppress_warnings = ['ref.python']

autodoc_default_options = {
    'members': True,
    'undoc-members': False,
    'show-inheritance': True,
    'member-order': 'bysource',
    # What a package exports is described where it is defined.
    'ignore-module-all': True,
    'exclude-members': 'model_config, model_post_init',
}
autodoc_typehints = 'signature'
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_ivar = True


def add_settings(
    app: Any, what: str, name: str, found: Any, options: Any, lines: list[str]
) -> None:
    """Add the fields of a settings model, with their descriptions, to its docstring."""
    if what != 'class' or not issubclass(found, BaseModel):
        return
    for key, field in found.model_fields.items():
        if field.description:
            shown = '' if field.is_required() else f' Default: ``{field.get_default()!r}``.'
            text = field.description.replace('*', r'\*').replace('|', r'\|').replace('_', r'\_')
            lines += ['', f'``{key}``', f'    {text}.{shown}']
    lines.append('')


def plain_words(app: Any, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Keep types in words from becoming links, and |x| from becoming a substitution."""
    for number, line in enumerate(lines):
        field = re.fullmatch(r'(\s*:(?:type|vartype|rtype)[^:]*:) ([^`]+)', line)
        if field:
            lines[number] = f'{field[1]} ``{field[2]}``'
            continue
        parts = re.split(r'(`[^`]*`)', line)
        parts[::2] = [part.replace('|', r'\|') for part in parts[::2]]
        lines[number] = ''.join(parts)


def short_contents(app: Any, page: str, template: str, context: Any, doctree: Any) -> None:
    """List the modules of the API on its own pages only; on all pages they take minutes."""
    whole = context.get('toctree')
    if whole:
        short = {'collapse': True} if page.startswith('api/') else {'maxdepth': 2}
        context['toctree'] = lambda **options: whole(**{**options, **short})


def setup(app: Any) -> None:
    """Connect to autodoc, after napoleon, and to the theme, before it."""
    app.connect('html-page-context', short_contents, priority=400)
    app.connect('autodoc-process-docstring', plain_words, priority=800)
    app.connect('autodoc-process-docstring', add_settings, priority=900)
