"""Motors of one make judged by each other: learning from sisters, of which some are sick, and the table of a fleet."""
