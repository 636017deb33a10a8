"""From signals to force: marker images, published recordings. Reads what `recorder` stores."""
