"""Sessions: one file that says what each verb is asked for in, one folder with all of their results out; and back."""
