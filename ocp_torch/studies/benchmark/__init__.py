"""Methods and models against each other: what each reaches after how many samples and how many seconds."""
