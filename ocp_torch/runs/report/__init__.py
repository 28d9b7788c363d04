"""Reports of one run or of many as HTML pages, made from the files in their folders."""
