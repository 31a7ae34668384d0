"""The DCNN of the paper's section 3.1: features, cost space, hourglasses, and the procedural scenes that train it.

The only folder that imports torch; nothing is imported from here until it is used.
"""
