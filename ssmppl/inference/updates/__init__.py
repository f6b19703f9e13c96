"""One update of parameters given statistics, done: a draw of a block, a maximum of Q."""
