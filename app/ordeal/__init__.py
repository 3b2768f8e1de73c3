"""An ordeal for a cell: random stories, played in the simulated workcell, against what has to hold in every tick."""
