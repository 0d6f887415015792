"""The image sensor: irradiance in, digital numbers out (EMVA 1288 release 4.0)."""
