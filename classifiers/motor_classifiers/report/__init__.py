"""The benchmark's page: charts, tables, HTML."""
