"""Functions of URScript that a controller offers to programs, by subject; `table` names them all."""
