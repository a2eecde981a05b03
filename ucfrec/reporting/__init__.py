"""Result rows, tables, charts and the report page."""
