"""The benchmark's page: charts, tables, HTML.

It never computes a score. Begin at `page`.
"""
