"""The verdict on a recording: commissioning of the healthy motor, decision, report and pictures."""
