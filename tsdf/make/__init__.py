"""How a table is made: rays, tallies, statistics, and the run that keeps them."""
