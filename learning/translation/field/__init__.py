"""The learned field translator: networks that predict how to deform the target's reference.

They never draw markers. Edges are therefore as sharp as in the reference, and patterns need not
have been seen in training.
"""
