"""How results are drawn and numbers are written: what the plots and the report share."""
