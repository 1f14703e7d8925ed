"""The benchmark's page: charts, tables, HTML. Begin at `page`."""
