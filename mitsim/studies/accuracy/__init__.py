"""The accuracy study: what each part of the light costs and brings."""
