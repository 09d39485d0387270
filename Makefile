# make demo    set everything up, simulate traffic, detect, score, draw
# make test    set everything up, check style and types, run the tests
# make docs    build the site from docs/ into site/
# The work is done by make.py, which runs without make too: python make.py demo
PYTHON ?= python3

.PHONY: setup demo test test-slow docs check constraints clean

setup demo test test-slow docs check constraints clean:
	@$(PYTHON) make.py $@
