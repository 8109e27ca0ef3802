"""What a page really plays, by the audio's own thread: when it begins to be loud, and for how long it is quiet."""

LISTEN = """window.begins = []; window.quiet = 0;
window.listen = async (context, output) => {
  const source = `registerProcessor("ear", class extends AudioWorkletProcessor {
    last = -1; count = 0;
    process([[samples]]) {
      for (let k = 0; samples && k < samples.length; ++k) {
        if (Math.abs(samples[k]) < 0.2) continue;
        const now = currentTime + k / sampleRate;
        if (now - this.last > 0.05) this.port.postMessage(["begins", now]);
        this.last = now;
      }
      if (++this.count % 16 === 0 && this.last > 0) this.port.postMessage(["quiet", currentTime - this.last]);
      return true;
    }
  });`;
  await context.audioWorklet.addModule(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
  const ear = new AudioWorkletNode(context, "ear");
  ear.port.onmessage = ({ data: [kind, time] }) => { kind === "begins" ? begins.push(time) : (quiet = time); };
  output.connect(ear);
  ear.connect(context.destination);
};
"""
"""Gives `listen(context, output)`, and fills `begins` and `quiet`, seconds of the context's time since it was loud."""
