"""The figures of a report, the colours of q, and which sweep gets which figure."""
