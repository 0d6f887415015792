"""RUN and CAL folders in, files that other programs read out; their files and real frames in, folders out."""
