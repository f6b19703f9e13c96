"""Random models, data, parameters and calls: a case ends in a result or in an error of ours."""
