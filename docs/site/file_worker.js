// Lets the search of the site run where its pages are opened as files: browsers refuse workers there, so a hidden frame
// takes their place. Loaded in the place of a script from another host (scripts/site.py); does nothing over HTTP.
"use strict";

class FrameWorker extends EventTarget {
  constructor(url) {
    super();
    this.onmessage = null;
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.appendChild(frame);
    this.window = frame.contentWindow;
    this.ready = new Promise((resolve) => {
      this.window.document.open();
      this.window.document.write("<!doctype html><body></body>");
      this.window.document.close();
      this.window.postMessage = (data) => {
        const copy = structuredClone(data); // as between a worker and its page: neither sees what the other changes
        setTimeout(() => this.deliver(copy));
      };
      this.window.importScripts = (...names) =>
        names.reduce((before, name) => before.then(() => this.load(name)), Promise.resolve());
      this.load(url).then(resolve);
    });
  }

  deliver(data) {
    const told = new MessageEvent("message", { data });
    this.dispatchEvent(told);
    this.onmessage?.(told);
  }

  load(url) {
    return new Promise((resolve, reject) => {
      const script = this.window.document.createElement("script");
      script.onload = resolve;
      script.onerror = reject;
      script.src = url;
      this.window.document.body.appendChild(script);
    });
  }

  postMessage(data) {
    const copy = structuredClone(data);
    this.ready.then(() => this.window.dispatchEvent(new MessageEvent("message", { data: copy })));
  }

  terminate() {
    this.window.frameElement.remove();
  }
}

if (location.protocol === "file:") window.Worker = FrameWorker;
