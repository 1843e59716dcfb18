"""Links: each module moves bytes of one kind of transport and does not interpret them.

``base`` defines the interface.
"""
