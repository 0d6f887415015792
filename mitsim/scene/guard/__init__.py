"""What a scene may hold: a file and all that it reads in, a refusal or the list of its files out."""
