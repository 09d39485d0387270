"""Labels of common annotation tools, read and written; see docs/label_formats.md."""
