"""Choice of the way to a sensor's forces, by errors on indenters that were left out."""
