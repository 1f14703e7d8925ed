"""Recordings of real motors: tables read, columns recognised, time and level put right, starts cut out."""
