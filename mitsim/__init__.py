"""mitsim: coded light on a scene in, frames of a lensless camera and the images recovered from them out.

Importing this package imports nothing, selects no Mitsuba variant and touches no global state.
"""

__version__ = "0.3.0"
