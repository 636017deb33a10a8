"""Coverage of the intervals of a transferred model, over skins of random modulus."""
