# The stages as rules of make, for projects that make drives anyway:
#
#   make -f docs/pipeline.mk                             the root pipeline.toml
#   make -f docs/pipeline.mk PIPELINE=photo/pipeline.toml OUT=photo/out INPUTS="photo/a.jpg photo/chair.glb"
#   make -f docs/pipeline.mk GIVEN=1                     [composite] environment gives the light
#   make -f docs/pipeline.mk REFERENCE=1                 no model guides: a reference, or the estimate alone
#
# Make goes by times of files, and by the whole of pipeline.toml: it runs more often than
# `dipir run`, which goes by what is in the files and by the keys that a stage reads.
BIN      ?= target/release/
PIPELINE ?= pipeline.toml
OUT      ?= $(dir $(PIPELINE))out
# The photograph, the objects, and whatever else should start all over when it changes.
INPUTS   ?=
FLAGS    ?=

run = $(BIN)$(1) --pipeline $(PIPELINE) --out $(OUT) $(FLAGS)
done = $(OUT)/$(1)/stage.json

.PHONY: all
all: $(call done,composite)

$(call done,scene): $(PIPELINE) $(INPUTS)
	$(call run,dipir-scene)

$(call done,concepts): $(PIPELINE)
	$(call run,dipir-concepts)

$(call done,lora): $(call done,concepts) $(INPUTS)
	$(call run,dipir-lora)

$(call done,light): $(call done,scene) $(if $(REFERENCE),,$(call done,lora))
	$(call run,dipir-light)

$(call done,composite): $(call done,scene) $(if $(GIVEN),,$(call done,light))
	$(call run,dipir-composite)
