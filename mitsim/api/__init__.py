"""The verbs: what one does with a bench and with its light; the objects themselves are data of the floors below."""
