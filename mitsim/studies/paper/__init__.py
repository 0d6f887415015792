"""Experiments of Zheng & Asif, one declared in each module: what varies, what is measured, what the paper claims."""
